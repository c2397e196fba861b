"""A run that grows to thousands of viewpoints: the real runner begins and resumes it, the rest is filled in.

The runner takes the first viewpoints, and a few at each size, on the in-memory rig of the tests. Those between are
recorded as a capture records them: photograph and poses into the store, one transaction with rows and event, then a
job that evaluates it, enqueued, claimed and finished. The photographs are sparse files (sparse.py).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from service.computations.live import LiveViewAnswer, LiveViewArguments
from service.computations.records import Camera, Limits, PosedPhotograph
from service.core.protocol import parse_protocol
from service.core.records.run_events import ViewpointCaptured
from service.rig import load_rig
from service.run_start import start_run
from service.steps import params_models
from service.store.records import NewArtefact, NewJob
from service.store.store import Store
from tests.support.runs.bench_run import PROTOCOL, Bench, HastyClock
from tests.support.soak.fit import Duration
from tests.support.soak.sparse import SparseFiles, sparse_photograph

STEP = "capture"
TIMED = 200  # viewpoints before each size that are recorded with every fsync and timed
_STATION = "station_1"
_POSES = 4  # poses per log; a real one has a hundred, which would only cost disk space here
_RIG = """\
name: large
simulated: true
devices: {robot: {driver: ur, host: 127.0.0.1}}
stations:
  station_1: {robot: robot, scene_centre_m: [0.0, 0.8, 0.0], approach_azimuth_deg: -90}
T_flange_camera_nominal: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]]
"""


class _DiedError(BaseException):
    """The runner's process died; nothing catches this."""


@dataclass
class LargeRecord:
    """A store in folder/data with one run that plans `planned` viewpoints."""

    folder: Path
    planned: int
    photograph_bytes: int
    store: Store = field(init=False)
    run_id: str = field(init=False)
    taken: int = field(init=False, default=0)
    _files: SparseFiles = field(init=False)
    _like: ViewpointCaptured = field(init=False)

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self._files = SparseFiles()
        self.store = Store.open(self.folder / "data", HastyClock(), files=self._files)
        text = PROTOCOL.replace("count: 4", f"count: {self.planned}")
        assert text != PROTOCOL
        rig = self.folder / "large.yaml"
        rig.write_text(_RIG)
        loaded = parse_protocol(text.encode(), params_models(), name="large.yaml")
        self.run_id = start_run(self.store, loaded, load_rig(rig), operator="Ada", auto_confirm=False)
        self.take(3)
        bench = Bench(self.store, self.run_id, self.folder / "data")
        self._like = bench.payloads(ViewpointCaptured)[0]
        self.taken = len(bench.captured())

    def close(self) -> None:
        """Close the store."""
        self.store.close()

    def grow(self, until: int) -> list[Duration]:
        """Record viewpoints until there are `until`; returns the durations of the last TIMED ones.

        The viewpoints before those are not synced one by one, which would take an hour.
        """
        took: list[Duration] = []
        photograph = self.folder / "photograph.jpg"
        while self.taken < until:
            number = self.taken + 1
            self._files.unhurried = until - self.taken <= TIMED
            sparse_photograph(photograph, number, self.photograph_bytes)
            began = Duration.now()
            self._bring(photograph, f"v{number:03d}", number)
            if self._files.unhurried:
                took.append(Duration.now().since(began))
            self.taken += 1
        return took

    def take(self, count: int) -> tuple[Duration, list[Duration]]:
        """Resume the run, take `count` more viewpoints and die.

        Returns the times of the first one and of the others.
        """
        bench = Bench(self.store, self.run_id, self.folder / "data")
        at: list[Duration] = []

        def exposed(_number: int) -> None:
            at.append(Duration.now())
            if len(at) > count:
                raise _DiedError

        bench.rig.shutter.on_capture = exposed
        began = Duration.now()
        try:
            bench.run()
        except _DiedError:
            pass
        else:
            raise AssertionError("the run ended before its time")
        self.taken += count
        return at[0].since(began), [later.since(earlier) for earlier, later in pairwise(at)]

    def _bring(self, photograph: Path, name: str, number: int) -> None:
        store, step = self.store, STEP
        image = store.put_file(
            photograph, kind="image", media_type="image/jpeg", original_name=f"DSC{number:05d}.JPG"
        )
        pose = {"controller_time_s": 1.25 * number, "T_base_flange": self._like.T_base_flange}
        log = store.put_bytes(
            "".join(json.dumps(pose) + "\n" for _ in range(_POSES)).encode(),
            kind="pose_log",
            media_type="application/x-ndjson",
            original_name=f"{name}.poses.jsonl",
        )
        captured = self._like.model_copy(
            update={"viewpoint": name, "artefacts": (image, log), "trigger_monotonic_s": 1.25 * number}
        )
        rows = [NewArtefact(ref, device, step, 1, name) for ref, device in ((image, "camera"), (log, "robot"))]
        store.record(self.run_id, [captured], actor="runner", artefacts=rows)
        looked = NewJob("live_view", step, 1, f"{step}/1/live_view/{name}", _arguments(name, image.sha256).plain())
        store.record(self.run_id, [], actor="runner", jobs=[looked])
        job = store.claim_job("worker", 60.0)
        assert job is not None
        found = json.dumps({"viewpoint": name, "spheres": number}).encode()
        answer = store.put_bytes(
            found, kind="live_view", media_type="application/json", original_name=f"{name}.live.json"
        )
        store.finish_job(
            job,
            measures={"spheres_seen": 10.0, "edge_width_px": 2.5, "outline_rms_px": 0.2, "clipped_fraction": 0.0},
            result=LiveViewAnswer(viewpoint=name, station=_STATION).plain(),
            duration_s=0.1,
            artefacts=[NewArtefact(answer, "worker", step, 1, name)],
        )


def _arguments(viewpoint: str, sha256: str) -> LiveViewArguments:
    """Of a job that nobody computes: as many numbers as a real one has."""
    return LiveViewArguments(
        camera=Camera(width=960, height=640, fx=1400.0, fy=1400.0, cx=480.0, cy=320.0, k1=-0.06, k2=0.02),
        T_flange_camera=tuple(map(tuple, np.eye(4).tolist())),
        hand_eye_covariance=tuple(map(tuple, (1e-8 * np.eye(6)).tolist())),
        arm_sigma_m=1e-4,
        arm_sigma_rad=1e-4,
        spheres_m=tuple((0.1 * k, 0.1, 0.1) for k in range(10)),
        radius_m=0.015,
        limits=Limits(min_views=3, max_angle_deg=60.0, max_distance_m=0.8),
        image=PosedPhotograph(viewpoint=viewpoint, sha256=sha256, station=_STATION),
    )
