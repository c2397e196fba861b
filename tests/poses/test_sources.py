"""What a registration waits for, what comes later, in which order, and what happens to late results."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.cli.runs import status_record
from service.computations import job_kinds
from service.core.gates import late_s, late_words
from service.core.geometry import look_at
from service.core.jobs import Reference
from service.core.protocol import LoadedProtocol, Protocol, load_protocol, parse_protocol
from service.core.records.base import ArtefactRef
from service.core.records.run_events import JobEnqueued, JobFinished
from service.core.run.fold import fold, initial_state
from service.core.run.state import LATER, REDUCED, WAITED, JobState, Note, RunState
from service.dataset.registrations import better_later, evaluated, own_registration, registrations
from service.dataset.summary import RunSummary
from service.followed_run import RunRecord
from service.run_start import recorded_run
from service.steps import params_models
from service.steps.due_jobs import due, missing_results
from service.steps.registration import PLANNED, decisive
from service.steps.registration_jobs import recorded_registration_jobs
from service.store.records import NewJob
from service.store.store import Store
from service.store.verification.verify import verify
from service.web.outlines import displayed_registration
from tests.support.record.store import enqueue
from tests.support.recorded.registration_record import SPHERES, registration_record
from tests.support.runs.computing_run import compute_jobs
from tests.support.runs.recorded_run import record_run

DEMO = Path(__file__).parents[2] / "protocols" / "demo.yaml"
CAMERA = {
    "width": 1280,
    "height": 853,
    "fx": 1000.0,
    "fy": 1000.0,
    "cx": 640.0,
    "cy": 426.0,
    "k1": 0.0,
    "k2": 0.0,
    "p1": 0.0,
    "p2": 0.0,
}
POSE = np.eye(4).tolist()
IMAGES = [
    {"viewpoint": f"v{i}", "sha256": f"{i:064x}", "station": "station_1", "step": "c", "T_base_flange": POSE}
    for i in range(4)
]
NOW = "2026-11-22T10:00:00Z"


def protocol(change: tuple[str, str] = ("", "")) -> Protocol:
    source = DEMO.read_text()
    assert change[0] in source
    source = source.replace(*change) if change[0] else source
    loaded: LoadedProtocol = parse_protocol(source.encode(), params_models(), name="demo.yaml")
    return loaded.protocol


@pytest.mark.parametrize(
    ("change", "waited"),
    [
        (("", ""), ("robot", "robot_corrected")),
        (("robot_corrected_rms_px", "colmap_rms_px"), ("robot", "robot_corrected", "colmap")),
        (("best_mean_radial_error_mm", "glomap_mean_radial_error_mm"), ("robot", "robot_corrected", "glomap")),
    ],
)
def test_a_step_waits_for_what_its_gates_name_and_for_what_takes_seconds(
    change: tuple[str, str], waited: tuple[str, ...]
) -> None:
    demo = protocol(change)
    assert decisive(demo, demo.step("registration")) == waited


class _Run:
    """A run whose registration has begun; its jobs finish on the test's command."""

    def __init__(self, demo: Protocol) -> None:
        self.protocol = demo
        state = initial_state(demo)
        note = Note(1, NOW, PLANNED, {}, 1)
        outlines = JobState("j0", "detect_spheres", 1, 1, "registration/0/detect_spheres/root/0", self._search())
        now = replace(state.steps["registration"], notes=(note,), jobs={"j0": outlines})
        self.state: RunState = replace(state, steps={**state.steps, "registration": now})
        self.count = 0

    def _search(self) -> dict[str, Any]:
        return {"images": IMAGES, "camera": CAMERA, "detector": "classical", **SPHERES}

    def due(self) -> list[NewJob]:
        return due(self.protocol, self.state)

    def enqueue(self, *jobs: NewJob) -> None:
        for new in jobs:
            self.count += 1
            job = JobState(
                f"j{self.count}", new.kind, new.attempt, 10 + self.count, new.idempotency_key, new.arguments,
                priority=new.priority,
            )  # fmt: skip
            self.put(new.step, job)

    def finish(self, kind: str, *, status: str = "finished") -> None:
        """Finish every open job of a kind."""
        for step, now in self.state.steps.items():
            for job in now.jobs.values():
                if job.kind == kind and job.status == "enqueued":
                    self.put(step, self._done(job, status))

    def _done(self, job: JobState, status: str) -> JobState:
        images = job.arguments.get("images", IMAGES)
        names = [str(image["viewpoint"]) for image in images] if job.kind == "features" else [job.kind]
        if job.kind == "structure_from_motion":
            names = [f"{job.arguments['mappers'][0]}{end}" for end in (".json", "_tracks.npz")]
        refs = tuple(
            ArtefactRef(sha256=f"{job.job}-{n}", kind="k", media_type="m", size_bytes=1, original_name=n)
            for n in names
        )
        eyes = [np.array([0.2 * i - 0.3, 0.3, 0.6]) for i in range(4)]
        poses = {f"v{i}": look_at(eye, np.zeros(3), np.array([0.0, 1.0, 0.0])).tolist() for i, eye in enumerate(eyes)}
        result = {"T_scan_camera": poses, "poses": job.arguments.get("poses"), "camera": job.arguments.get("camera")}
        result["full_camera"] = job.arguments.get("full_camera")
        return replace(job, status=status, artefacts=refs, result=result, message="said so", duration_s=2.0)

    def put(self, step: str, job: JobState) -> None:
        now = self.state.steps[step]
        changed = replace(now, jobs={**now.jobs, job.job: job})
        self.state = replace(self.state, steps={**self.state.steps, step: changed})


def test_each_job_is_due_when_its_input_is_there_and_once(tmp_path: Path) -> None:
    run = _Run(protocol())
    assert run.due() == []  # the outlines are being searched
    run.finish("detect_spheres")
    first = run.due()
    assert [(job.kind, job.arguments["poses"], job.priority) for job in first] == [
        ("register", "robot", WAITED),
        ("register", "robot_corrected", WAITED),
    ]
    run.enqueue(*first)
    assert run.due() == []
    for kind, following in (
        ("register", {"features"}),
        ("features", {"match"}),
        ("match", {"structure_from_motion"}),
        ("structure_from_motion", {"register", "hybrid"}),
        ("hybrid", {"register"}),
    ):
        run.finish(kind)
        jobs = run.due()
        assert {job.kind for job in jobs} == following
        assert all(job.priority in (LATER, REDUCED) for job in jobs)
        run.enqueue(*jobs)
        assert run.due() == []
    mapped = [j for j in run.state.steps["registration"].jobs.values() if j.kind == "structure_from_motion"]
    assert sorted(j.arguments["mappers"][0] for j in mapped) == [
        "global",
        "incremental",
        "triangulated",
    ]  # in parallel
    run.finish("register")
    found = recorded_registration_jobs(run.protocol, run.state, run.protocol.step("registration"))
    assert found is not None
    assert set(found.arrived) == {"robot", "robot_corrected", "triangulated", "colmap", "glomap", "hybrid"}
    assert run.due() == []


def test_every_job_is_of_the_version_that_computes_it_also_a_late_evaluation() -> None:
    run = _Run(protocol())
    own = JobState(
        "own", "evaluate", 1, 2, "evaluation/0/evaluate/own/0", {"registrations": {"robot": {}}}, "finished"
    )
    run.put("evaluation", own)
    run.finish("detect_spheres")
    kinds: set[str] = set()
    while jobs := run.due():
        for job in jobs:
            assert job.version == job_kinds()[job.kind].version, job.kind
        kinds |= {job.kind for job in jobs}
        run.enqueue(*jobs)
        for kind in kinds:
            run.finish(kind)
    assert kinds >= {"register", "features", "match", "structure_from_motion", "hybrid", "evaluate"}


def test_the_jobs_refer_to_earlier_answers_and_poses_as_reported_are_not_corrected() -> None:
    correction = {"T_flange_camera": POSE, "arm": "UR10e", "dh_deltas": [[0.0] * 4] * 6, "observed": [1.0] * 6}
    correction |= {"gear_cos_rad": [[0.0]] * 6, "gear_sin_rad": [[0.0]] * 6}
    result = {"camera": CAMERA, "T_flange_camera": POSE, "hand_eye": {"arm_correction": correction}}
    calibrated = JobState("cal", "calibrate", 1, 1, "calibration/0/calibrate/c/0", {}, "finished", result=result)
    camera, corrected = Reference("cal", "result/camera"), Reference("cal", "result/hand_eye/arm_correction")
    arm = {"T_flange_camera": POSE, "arm_correction": corrected.record(), "stations": ["station_2"]}
    run = _Run(protocol())
    run.put("camera_calibration", calibrated)
    (search,) = run.state.steps["registration"].jobs.values()
    arguments = {**search.arguments, "camera": camera.record(), "T_flange_camera": POSE}
    arguments |= {"arm_correction": corrected.record(), "arm_stations": ["station_1"], "further_arms": [arm]}
    run.put("registration", replace(search, arguments=arguments))
    run.finish("detect_spheres")
    reported, as_corrected = (job.arguments for job in run.due())
    assert as_corrected["camera"] == reported["camera"] == camera.record()
    assert as_corrected["arm_correction"] == corrected.record()
    assert as_corrected["further_arms"] == [arm]
    assert reported["arm_correction"] is None
    assert reported["further_arms"] == [{**arm, "arm_correction": None}]


def test_a_way_that_failed_is_said_to_have_failed_and_not_tried_again_by_itself() -> None:
    run = _Run(protocol())
    run.finish("detect_spheres")
    for kind in ("register", "features", "match"):
        run.enqueue(*run.due())
        run.finish(kind)
    run.enqueue(*run.due())
    run.finish("structure_from_motion", status="failed")
    assert run.due() == []
    left = missing_results(run.protocol, run.state, {}, NOW, 2)
    assert {one.name for one in left} == {"triangulated", "colmap", "glomap", "hybrid"}
    assert all("said so" in one.failed for one in left)


def test_a_size_that_is_no_reduction_of_the_photographs_is_left_out_and_holds_nothing_up() -> None:
    effort = "structure_from_motion: {max_image_size: 960, max_features: 1500, neighbours: 8}"
    run = _Run(protocol((effort, effort + "\n      reduced: [640x360, 4752x3168]")))
    run.finish("detect_spheres")
    found = recorded_registration_jobs(run.protocol, run.state, run.protocol.step("registration"))
    assert found is not None
    assert set(found.failed) == {"colmap_4752x3168"}
    left = {one.name: one.failed for one in missing_results(run.protocol, run.state, {}, NOW, 2)}
    assert "1280 × 853" in left["colmap_4752x3168"]
    assert left["colmap_640x360"] == ""


def test_the_time_left_follows_from_what_such_jobs_took() -> None:
    run = _Run(protocol())
    run.finish("detect_spheres")
    for kind in ("register", "features"):
        run.enqueue(*run.due())
        run.finish(kind)
    left = missing_results(run.protocol, run.state, {}, NOW, 2)
    assert [one.name for one in left][-1] == "hybrid"  # it needs a model first
    assert all(one.seconds > 0 for one in left)
    assert "about" in left[0].text


def test_a_run_recorded_before_results_could_come_later_misses_nothing() -> None:
    run = _Run(protocol())
    now = replace(run.state.steps["registration"], notes=())
    run.state = replace(run.state, steps={**run.state.steps, "registration": now})
    run.finish("detect_spheres")
    assert run.due() == []
    assert missing_results(run.protocol, run.state, {}, NOW, 2) == []


@pytest.mark.slow
def test_a_later_and_better_registration_is_reported_and_takes_nobodys_place() -> None:
    run = _Run(protocol())
    steps = dict(run.state.steps)
    signed = {"poses": "robot_corrected", "mean_radial_error_mm": 0.02}
    steps["evaluation"] = replace(steps["evaluation"], result={"table": [signed], "budgets": {}})
    later = JobState(
        "e", "evaluate", 1, 9, "evaluation/0/evaluate/colmap-x/0", {}, "finished", priority=LATER, late_s=720.0,
        result={"table": [{"poses": "colmap", "mean_radial_error_mm": 0.01}], "budgets": {"colmap": {}}},
    )  # fmt: skip
    steps["evaluation"] = replace(steps["evaluation"], jobs={"e": later})
    state = replace(run.state, steps=steps)
    assert own_registration(run.protocol, state) == "robot_corrected"
    assert [(row.poses, row.late) for row in evaluated(run.protocol, state)] == [
        ("robot_corrected", ""),
        ("colmap", "arrived 12 min after the end of the run"),
    ]
    better = better_later(run.protocol, state)
    assert better is not None
    assert better.poses == "colmap"


def test_page_report_and_export_show_the_same_registration(tmp_path: Path) -> None:
    """Before the evaluation the most certain of full resolution, then what was signed, whatever its resolution."""

    def registered(poses: str, variance: float, full: dict[str, Any] | None = None) -> dict[str, Any]:
        return registration_record(
            poses,
            camera=CAMERA | {"width": 640, "height": 360},
            full_camera=None if full is None else CAMERA | full,
            covariance=(variance * np.eye(6)).tolist(),
        )

    run = _Run(protocol())
    steps = dict(run.state.steps)
    records = {
        "robot": registered("robot", 4e-10),
        "colmap": registered("colmap", 1e-10),
        "colmap_640x360": registered("colmap", 0.5e-10, {"width": 1280, "height": 720}),
    }
    steps["registration"] = replace(steps["registration"], result={"registrations": records})
    begun = replace(run.state, steps=dict(steps))
    rows = [
        {"poses": "robot", "mean_radial_error_mm": 0.02},
        {"poses": "colmap_640x360", "mean_radial_error_mm": 0.01},
    ]
    steps["evaluation"] = replace(steps["evaluation"], result={"table": rows, "budgets": {}})
    judged = replace(run.state, steps=steps)
    with Store.open(tmp_path) as store:
        shown = [displayed_registration(RunRecord("a", run.protocol, (), state, store)) for state in (begun, judged)]
        reported = [RunSummary("a", run.protocol, (), state, store).best() for state in (begun, judged)]
    assert [None if one is None else one.name for one in shown] == ["colmap", "colmap_640x360"]
    assert reported == [None, "colmap_640x360"], "nothing is reported or exported that was not evaluated"


def test_lateness_counts_from_when_the_specimen_was_freed() -> None:
    demo = load_protocol(DEMO, params_models()).protocol
    state = initial_state(demo)
    assert late_s(demo, state, NOW) is None
    release = replace(state.steps["specimen_release"], phase="passed", ended_utc="2026-11-22T09:58:00Z")
    state = replace(state, steps={**state.steps, "specimen_release": release})
    assert late_s(demo, state, NOW) == 120.0
    assert late_words(demo, state, 20.0) == "arrived after the specimen was freed"
    assert late_words(demo, initial_state(demo), 720.0) == "arrived 12 min after the end of the run"


@pytest.mark.slow
def test_a_result_that_arrives_after_the_end_of_a_run_is_recorded_as_late_signed_and_verifies(tmp_path: Path) -> None:
    run_id = record_run(tmp_path)
    data = tmp_path / "data"
    with Store.open(data) as store:
        done = next(e.payload for e in store.events(run_id) if _is_registration(e.payload))
        assert isinstance(done, JobEnqueued)
        again = NewJob("register", done.step, done.attempt, "later", done.arguments, priority=LATER)
        enqueue(store, run_id, again, actor="worker")
        assert compute_jobs(store) == 1
        end = store.events(run_id)[-1].payload
        assert isinstance(end, JobFinished)
        assert end.late_s is not None
        report = verify(data, run_id)
        assert report.ok
        assert report.unsigned_events[run_id] == 0  # it has a checkpoint of its own
        recorded, _ = recorded_run(store, run_id)
        state = fold(recorded, store.events(run_id))
        assert state.status == "completed"
        assert not state.overtaken
        assert registrations(recorded, state)
        assert status_record(run_id, state)["status"] == "completed"


def _is_registration(payload: object) -> bool:
    return isinstance(payload, JobEnqueued) and payload.job_kind == "register"
