"""A whole site as processes: PostgreSQL, an object store, a Dask cluster, the server of the screens and a job worker.

`serve_command` and `worker_command` are the commands that docs/deploy starts with systemd and in containers.
"""

from __future__ import annotations

import json
import os
import signal
import ssl
import subprocess
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import yaml

from service.store.objects.s3 import S3Objects
from tests.support.pages.certificates import self_signed
from tests.support.processes import cluster, postgres
from tests.support.processes.forked import Forked
from tests.support.processes.object_store import Weed
from tests.support.processes.waiting import until
from tests.support.rig.rig import REPOSITORY, command

DASK_WORKERS = 2
_GRACE_S = 60.0


def serve_command(rig: Path, data: Path, certificate: Path, key: Path, port: int = 0) -> tuple[str, ...]:
    """The command that serves the screens over TLS."""
    return (
        "serve", "--rig", str(rig), "--data", str(data), "--host", "127.0.0.1", "--port", str(port),
        "--tls-certificate", str(certificate), "--tls-key", str(key),
    )  # fmt: skip


def worker_command(data: Path) -> tuple[str, ...]:
    """The command that computes jobs; ORTHOCAPTURE_SCHEDULER in its environment names a cluster."""
    return ("worker", "--data", str(data))


@dataclass
class Site:
    """The servers of a site, and its data folder."""

    data: Path
    postgres: postgres.Cluster
    database: str
    weed: Weed
    objects: S3Objects
    dask: cluster.Cluster

    def processes(self) -> dict[str, list[int]]:
        """The ids of the servers' processes, by what they are."""
        return {
            "PostgreSQL": [self.postgres.pid],
            "SeaweedFS": [self.weed.pid],
            "Dask scheduler": [self.dask.scheduler.pid],
            "Dask workers": [worker.pid for worker in self.dask.workers],
        }

    @property
    def worker_environment(self) -> dict[str, str]:
        """The variables that a job worker has besides: they name the cluster."""
        return {"ORTHOCAPTURE_SCHEDULER": self.dask.address}


@contextmanager
def site_servers(folder: Path, *, free_after_days: float = 0) -> Generator[Site]:
    """Start the servers of a site, prepare its database and write its site.yaml; all of them end with the block."""
    data = folder / "data"
    weed, server = Weed(folder / "weed"), postgres.Cluster()
    try:
        server.start()
        try:
            weed.start()
            with cluster.dask_cluster(_new_folder(folder / "dask"), workers=DASK_WORKERS) as dask:
                data.mkdir(mode=0o700)
                objects = weed.write_site(data, free_after_days=free_after_days)
                database = server.new_database()
                about = yaml.safe_load((data / "site.yaml").read_text(encoding="utf-8"))
                about["database"] = server.url(database, postgres.ROLE)
                (data / "site.yaml").write_text(yaml.safe_dump(about), encoding="utf-8")
                yield Site(data, server, database, weed, objects, dask)
        finally:
            weed.kill()
    finally:
        server.stop()


def _new_folder(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder


@dataclass(frozen=True)
class Screens:
    """The server of the screens: its address, how its certificate is checked, and its process."""

    url: str
    set_up: str
    trust: ssl.SSLContext
    process: subprocess.Popen[bytes]

    def get(self, path: str) -> httpx.Response:
        """Fetch what everybody may see."""
        return httpx.get(f"{self.url}{path}", verify=self.trust, timeout=60)


@contextmanager
def process_of(
    arguments: tuple[str, ...], log: Path, environment: Mapping[str, str] | None = None
) -> Generator[subprocess.Popen[bytes]]:
    """Start `orthocapture ARGUMENTS` with its output in a file; SIGTERM ends it with the block, as systemd would."""
    with log.open("ab") as output:
        process = Forked(
            command(*arguments), cwd=REPOSITORY, env={**os.environ, **(environment or {})},
            stdin=subprocess.DEVNULL, stdout=output, stderr=output,
        )  # fmt: skip
    try:
        yield process
    finally:
        end(process)


def end(process: subprocess.Popen[bytes]) -> None:
    """End a process with SIGTERM, and with SIGKILL if it does not come to its end."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(_GRACE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@contextmanager
def screens(rig: Path, data: Path, folder: Path) -> Generator[Screens]:
    """Serve the screens of a data folder over TLS, with a certificate of its own."""
    certificate, key = self_signed(folder)
    log = folder / "serve.log"
    with process_of((*serve_command(rig, data, certificate, key), "--json"), log) as process:

        def ready() -> bool:
            assert process.poll() is None, log.read_text(encoding="utf-8")
            return log.is_file() and '"url"' in log.read_text(encoding="utf-8")

        until(ready, "the server of the screens does not start")
        lines = log.read_text(encoding="utf-8").splitlines()
        said = json.loads(next(line for line in lines if '"url"' in line))
        trust = ssl.create_default_context(cafile=certificate)
        yield Screens(said["url"], said["set_up"], trust, process)
