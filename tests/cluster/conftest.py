"""The cluster that the tests of this folder share."""

from __future__ import annotations

from collections.abc import Generator

import pytest

from tests.support.processes.cluster import Cluster, dask_cluster
from tests.support.processes.forked import Forked


@pytest.fixture(scope="package")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Generator[Cluster]:
    """Two workers, which no test may leave dead."""
    with dask_cluster(tmp_path_factory.mktemp("cluster"), start=Forked) as started:
        yield started
