"""For tests of the store: controlled clocks and ids, file operations that crash or lose power, and a run."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from datetime import datetime
from pathlib import Path

from service.core.records.base import ArtefactRef
from service.core.records.run_events import RunStarted, ViewpointCaptured
from service.store.durable_effects import DurableFiles
from service.store.records import Job, NewArtefact, NewJob
from service.store.store import Store

IDENTITY4 = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


class CountedIds:
    """Ids that count up from 1, so that every test run has the same ones."""

    def __init__(self) -> None:
        self.count = 0

    def _next(self) -> str:
        self.count += 1
        return f"{self.count:032x}"

    def new_run(self, at: datetime) -> str:
        return f"{at:%Y%m%d-%H%M%S}-{self._next()[-6:]}"

    def new_job(self) -> str:
        return f"job-{self._next()}"

    def new_token(self) -> str:
        return self._next()


class Crash(BaseException):
    """The process is gone; no error handler may catch this."""


class CrashingFiles:
    """Records the file operations and dies at point `crash_at`; once dead, it does nothing.

    Each call has three points: before it, within it (a write is cut in half, a commit does not happen), and after it.
    `lose_power` then removes what was never made durable: data without fsync, names without fsync of the folder.
    """

    def __init__(self, crash_at: int | None = None) -> None:
        self.crash_at = crash_at
        self.points: list[str] = []
        self.dead = False
        self._real = DurableFiles()
        self._unsynced_data: set[Path] = set()
        self._unsynced_ends: dict[Path, int] = {}  # file → how much of it is certain
        self._unsynced_names: dict[Path, Path | None] = {}  # name → its previous name

    def _point(self, name: str) -> None:
        if self.dead:
            raise Crash
        self.points.append(name)
        if len(self.points) - 1 == self.crash_at:
            self.dead = True
            raise Crash(name)

    def _call(self, name: str, act: Callable[[], None], within: Callable[[], None] | None = None) -> None:
        self._point(f"before {name}")
        try:
            self._point(f"within {name}")
        except Crash:
            if within is not None:
                within()
            raise
        act()
        self._point(f"after {name}")

    def make_directory(self, path: Path, *, private: bool = False) -> None:
        def act() -> None:
            if not path.exists():
                self._real.make_directory(path, private=private)
                self._unsynced_names[path] = None

        self._call("make_directory", act)

    def write(self, path: Path, chunks: Iterable[bytes], *, private: bool = False) -> None:
        def act() -> None:
            self._unsynced_names[path] = None
            self._unsynced_data.add(path)
            self._real.write(path, chunks, private=private)

        def half() -> None:
            data = b"".join(chunks)
            self._unsynced_names[path] = None
            self._unsynced_data.add(path)
            self._real.write(path, [data[: len(data) // 2]])

        self._call("write", act, half)

    def append(self, path: Path, offset: int, data: bytes) -> None:
        def act(data: bytes = data) -> None:
            self._unsynced_ends.setdefault(path, offset)
            self._unsynced_ends[path] = min(offset, self._unsynced_ends[path])
            self._real.append(path, offset, data)

        self._call("append", act, lambda: act(data[: len(data) // 2]))

    def make_read_only(self, path: Path) -> None:
        self._call("make_read_only", lambda: self._real.make_read_only(path))

    def sync_file(self, path: Path) -> None:
        def act() -> None:
            self._real.sync_file(path)
            self._unsynced_data.discard(path)
            self._unsynced_ends.pop(path, None)

        self._call("sync_file", act)

    def rename(self, source: Path, target: Path) -> None:
        def act() -> None:
            self._real.rename(source, target)
            self._unsynced_names.pop(source, None)
            self._unsynced_names[target] = source
            if source in self._unsynced_data:
                self._unsynced_data.remove(source)
                self._unsynced_data.add(target)

        self._call("rename", act)

    def sync_directory(self, path: Path) -> None:
        def act() -> None:
            self._real.sync_directory(path)
            self._unsynced_names = {name: was for name, was in self._unsynced_names.items() if name.parent != path}

        self._call("sync_directory", act)

    def remove(self, path: Path) -> None:
        self._call("remove", lambda: self._real.remove(path))

    def commit(self, commit: Callable[[], None]) -> None:
        self._call("commit", commit)

    def lose_power(self) -> None:
        """Empty the files whose data was not synced, cut what was not, undo unsynced names, the deepest first."""
        for path, certain in self._unsynced_ends.items():
            if path.exists():
                os.truncate(path, certain)
        for path in self._unsynced_data:
            if path.exists():
                path.chmod(0o644)
                path.write_bytes(b"")
        for path, was in sorted(self._unsynced_names.items(), key=lambda item: -len(item[0].parts)):
            if path.is_dir():
                for child in sorted(path.rglob("*"), reverse=True):
                    child.rmdir() if child.is_dir() else child.unlink()
                path.rmdir()
            elif path.exists():
                if was is not None and was.parent.exists():
                    path.rename(was)
                else:
                    path.unlink()


def start_run(store: Store, *, simulated: bool = True) -> str:
    """Begin a run with its protocol and rig."""
    protocol = store.put_bytes(b"id: demo\n", kind="protocol", media_type="text/yaml", original_name="demo.yaml")
    rig = store.put_bytes(b"name: rig\n", kind="rig", media_type="text/yaml", original_name="rig.yaml")
    payload = RunStarted(
        protocol_id="demo",
        protocol_version="1",
        protocol_sha256=protocol.sha256,
        protocol=protocol,
        rig=rig,
        simulated=simulated,
        auto_confirm=True,
        operator="Ada",
        software={"orthocapture": "0.1.0"},
    )
    return store.create_run(payload, "Ada", [NewArtefact(protocol, "service"), NewArtefact(rig, "service")])


def captured(ref: ArtefactRef, viewpoint: str, **changes: object) -> ViewpointCaptured:
    """The event of one exposure."""
    fields: dict[str, object] = {
        "step": "capture",
        "attempt": 1,
        "viewpoint": viewpoint,
        "station": "station_1",
        "artefacts": (ref,),
        "T_base_flange": IDENTITY4,
        "pose_sigma_m": 1e-5,
        "pose_sigma_rad": 2e-5,
        "joints_rad": (0.1, -1.2, 1.3, 0.0, 0.5, -0.0),
        "pose_samples": 60,
        "trigger_monotonic_s": 1.25,
        "arrival_monotonic_s": 2.5,
        "controller_time_s": 1e20,
        "clock_offset_s": 0.0,
        "camera": {"iso": 100, "exposure_s": 1 / 15},
    }
    return ViewpointCaptured.model_validate(fields | changes)


def put_image(store: Store, viewpoint: str, size: int = 2000) -> ArtefactRef:
    """Store bytes that differ for each viewpoint."""
    data = viewpoint.encode().ljust(size, b"\xff")
    return store.put_bytes(data, kind="image", media_type="image/jpeg", original_name=f"{viewpoint}.JPG")


def capture(store: Store, run_id: str, viewpoint: str) -> ArtefactRef:
    """Store an image and record it, as a capture does."""
    ref = put_image(store, viewpoint)
    store.record(
        run_id,
        [captured(ref, viewpoint)],
        actor="camera",
        artefacts=[NewArtefact(ref, "camera", "capture", 1, viewpoint, "Ada")],
    )
    return ref


def files_of(data_dir: Path) -> Iterator[Path]:
    """Every file below the artefact folder."""
    return (path for path in (data_dir / "artefacts").rglob("*") if path.is_file())


def enqueue(store: Store, run_id: str, job: NewJob, *, actor: str) -> Job:
    """Enqueue a job with no other event, and return it, or the existing job with its key."""
    store.record(run_id, [], actor=actor, jobs=[job])
    return next(found for found in store.jobs(run_id) if found.idempotency_key == job.idempotency_key)
