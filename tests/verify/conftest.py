"""Fixtures of the tests of bundles."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.support.record.bundled_site import Site, bundled_site


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    return bundled_site(tmp_path_factory.mktemp("site"))


@pytest.fixture
def unpacked(site: Site, tmp_path: Path) -> Path:
    shutil.copytree(site.folder, tmp_path / "bundle")
    return tmp_path / "bundle"
