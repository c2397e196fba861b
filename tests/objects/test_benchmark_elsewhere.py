"""A machine that has nothing of a site but its site.yaml takes the benchmark from the queue and answers it."""

from __future__ import annotations

import shutil
import threading
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from service.cli.main import app
from service.store.objects.upload import Uploader
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.processes.object_store import Weed
from tests.support.processes.postgres import Cluster
from tests.support.processes.waiting import until
from tests.support.recorded.benchmarked_run import ASKED, METHOD, BenchmarkedRun, unpack_benchmarked_run

pytestmark = [
    pytest.mark.packages("postgresql"),
    pytest.mark.timeout(300),
    pytest.mark.sqlite("shares the database of a server by itself"),
]


@pytest.mark.slow
def test_the_machine_fetches_the_photographs_and_its_mesh_arrives_at_the_site(weed: Weed, tmp_path: Path) -> None:
    run = unpack_benchmarked_run(tmp_path)
    site, machine = BenchmarkedRun(tmp_path, tmp_path / "site"), tmp_path / "machine"
    objects = weed.write_site(site.data)
    cluster = Cluster(brief=True)
    cluster.start()
    try:
        about = yaml.safe_load((site.data / "site.yaml").read_text(encoding="utf-8"))
        about["database"] = cluster.address()
        (site.data / "site.yaml").write_text(yaml.safe_dump(about), encoding="utf-8")
        command = ["store", "copy", str(run.data), str(site.data), "--operator", "Erika"]
        assert CliRunner().invoke(app, command, catch_exceptions=False).exit_code == 0
        with Store.open(site.data) as store:
            Uploader(store, objects).drain()
        machine.mkdir(mode=0o700)
        for name in ("site.yaml", "store_keys.yaml"):
            shutil.copy2(site.data / name, machine / name)

        def serve() -> None:
            with Store.open(machine) as store:
                until(lambda: store.open_jobs() > 0, "no job comes")
                done.append(site.worker(machine, method=True))
                Uploader(store, objects).drain()

        done: list[int] = []
        with site.machine(method=True):
            worker = threading.Thread(target=serve)
            worker.start()
            command = ["benchmark", "run", "latest", "--method", METHOD, *ASKED, "--out", str(tmp_path / "out")]
            status, printed = site.call(*command)
            worker.join()
        assert (status, done) == (0, [1]), printed
        assert len(list((machine / "fetched").glob("*/*"))) > 5  # photographs, protocol, scan
        assert (tmp_path / "out" / f"{METHOD}-sparse" / "mesh.ply").is_file()
        assert printed["machine"]["cores"] > 0
        assert verify(site.data).ok
    finally:
        cluster.stop()
