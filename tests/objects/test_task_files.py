"""Workers of a Dask cluster that do not see the data folder fetch what tasks read from the site's object store."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from service.core.errors import DataError
from service.machine.executors import mapping
from service.store.objects.upload import Uploader
from service.store.store import Store
from tests.support.processes import cluster_tasks as tasks
from tests.support.processes.cluster import dask_cluster, on, stopped
from tests.support.processes.object_store import Weed
from tests.support.record.store import capture, start_run

PRELOAD = "service.store.objects.task_files"


@pytest.mark.slow
def test_workers_without_the_data_folder_compute_on_its_artefacts(weed: Weed, tmp_path: Path) -> None:
    data, elsewhere, temporary = tmp_path / "data", tmp_path / "elsewhere", tmp_path / "temporary"
    objects = weed.write_site(data)
    with Store.open(data) as store:
        run = start_run(store)
        refs = [capture(store, run, viewpoint) for viewpoint in ("v1", "v2", "v3")]
        files = [store.artefact_path(ref.sha256) for ref in refs]
        contents = [file.read_bytes() for file in files]
        Uploader(store, objects).drain()
    elsewhere.mkdir()
    temporary.mkdir()
    for name in ("site.yaml", "store_keys.yaml"):
        shutil.copy2(data / name, elsewhere / name)
    loose = tmp_path / "loose.jpg"
    loose.write_bytes(b"no artefact")
    with dask_cluster(tmp_path, workers=0) as cluster:
        cluster.add_worker({"ORTHOCAPTURE_SITE": str(elsewhere), "TMPDIR": str(temporary)}, "--preload", PRELOAD)
        with on(cluster), mapping(1, 4) as map_over:
            with stopped(cluster):
                answers = [map_over(tasks.read, [*files, *files]), map_over(tasks.read, [loose, loose])]
                for path in (data, loose):
                    path.rename(path.with_name(f"{path.name}, on another machine"))
            assert list(answers[0]) == contents * 2
            with pytest.raises(DataError, match="does not see the file"):
                list(answers[1])
    assert sorted(file.read_bytes() for file in (elsewhere / "fetched").glob("*/*")) == sorted(contents)
