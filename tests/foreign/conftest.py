"""A posed data set of photographs of a known solid, for exports that are read back."""

from __future__ import annotations

import pytest

from service.dataset.records import DataSet
from tests.support.scenes.posed import posed_data_set


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    return posed_data_set(tmp_path_factory.mktemp("photographs"))
