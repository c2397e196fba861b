"""What each image adds during a capture, in its images, its jobs and its runs."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.interfaces import CameraSettings
from service.computations.conversion import arm_correction_record
from service.computations.inputs import robot_camera_poses
from service.computations.job import JobAnswer, JobContext, RecordedContext
from service.computations.live import LIVE_VIEW
from service.compute.arm_kinematics import ArmCorrection, corrected_T_base_flange, postures
from service.compute.live import LiveView, clipped_fraction, register_station, sharpness
from service.compute.markers.predicted import NEAR, ImageOutlines, PredictedSpheres, find_outlines, tone_of
from service.compute.planning.coverage import (
    CoverageLimits,
)
from service.compute.registration.hypotheses import paired
from service.core.arms import arm_model
from service.core.geometry import Array, apply, inverse, transform
from service.core.records.run_events import GatesEvaluated, StepNote
from service.store.store import Store
from service.worker.loop import HANDLERS, work
from tests.support.rig.bench_rig import answer, other_settings
from tests.support.runs.bench_run import PROTOCOL, Bench, begin_run, bench_store
from tests.support.runs.computing_run import compute_jobs
from tests.support.runs.measuring_rig import CENTRE_M, MEASURED, SPHERES_M, BenchCt, MeasuringRig, hill
from tests.support.scenes.sphere_images import (
    RADIUS_M,
    Scene,
    camera,
    exact_outlines,
    render,
    scene,
)

# --- images ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pictures() -> tuple[Scene, list[Any]]:
    made = scene(3, width=1000, seed=11)
    return made, [render(made.camera, made.centres_camera(i, SPHERES_M), seed=i) for i in range(3)]


@pytest.mark.slow
def test_prediction_finds_what_a_search_of_the_whole_image_finds(pictures: tuple[Scene, list[Any]]) -> None:
    made, images = pictures
    T_camera_scan = inverse(made.T_world_camera[0]) @ made.T_world_scan
    whole = find_outlines(images[0], made.camera, None).outlines

    def near_to(off_m: Array) -> PredictedSpheres:
        return PredictedSpheres(
            transform(np.eye(3), off_m) @ T_camera_scan, SPHERES_M, RADIUS_M, NEAR, tone_of(whole)
        )

    near = find_outlines(images[0], made.camera, near_to(np.full(3, 5e-4))).outlines
    assert len(near) >= len(whole) >= 6
    by_marker = {m: whole[o] for o, m in paired(whole, T_camera_scan, SPHERES_M, RADIUS_M, made.camera).items()}
    for o, m in paired(near, T_camera_scan, SPHERES_M, RADIUS_M, made.camera).items():
        if m in by_marker:
            assert np.allclose(near[o].centre_px, by_marker[m].centre_px, atol=0.2)
    lost = find_outlines(images[0], made.camera, near_to(np.array([0.1, 0.0, 0.0]))).outlines
    assert len(lost) == len(whole), "a prediction that is wrong is noticed, and the whole image searched"
    quality = sharpness(images[0], near, made.camera)
    blurred = sharpness(cv2.GaussianBlur(images[0], (0, 0), 2.5), near, made.camera)
    assert blurred.edge_px > 1.5 * quality.edge_px


def test_clipped_pixels_are_counted_whichever_channel_clips() -> None:
    image = np.full((400, 600, 3), 200, dtype=np.uint8)
    assert clipped_fraction(image) == 0.0
    image[:100, :, 0] = 255
    assert clipped_fraction(image) == pytest.approx(0.25)
    image[200:300, :300, 2] = 254  # a clipped pixel after JPEG
    assert clipped_fraction(image) == pytest.approx(0.375)


@pytest.mark.slow
def test_images_register_one_after_the_other(pictures: tuple[Scene, list[Any]]) -> None:
    made, images = pictures
    known, views = None, list[LiveView]()
    for i, image in enumerate(images):
        expected = None
        if known is not None:
            shown = tone_of([o for view in views for o in view.outlines])
            expected = PredictedSpheres(inverse(made.T_world_camera[i]) @ known, SPHERES_M, RADIUS_M, NEAR, shown)
        outlines = find_outlines(image, made.camera, expected).outlines
        views.append(LiveView(f"v{i}", made.T_world_camera[i], outlines))
        known = register_station(views, SPHERES_M, RADIUS_M, made.camera, known).T_base_scan
        error = np.linalg.norm(apply(known, CENTRE_M) - apply(made.T_world_scan, CENTRE_M))
        assert error < 0.15e-3


# --- jobs ------------------------------------------------------------------------------------------------


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(tmp_path / "data") as opened:
        yield opened


STATION = "station_1"


def erring_arm(made: Scene) -> tuple[Array, list[dict[str, Any]], dict[str, Any]]:
    """T_base_world, the poses reported by an arm with millimetre errors for a scene's cameras, and its correction."""
    arm, T_flange_camera = arm_model("UR10e"), transform(np.eye(3), np.array([0.0, -0.055, 0.095]))
    deltas = np.zeros((6, 5))
    deltas[:, :4] = np.random.default_rng(3).normal(0, 5e-4, (6, 4))
    correction = ArmCorrection("UR10e", deltas, np.zeros((6, 10)), np.zeros((6, 10)), np.ones(6))
    T_base_world = transform(np.eye(3), np.array([0.0, 0.7, -0.1])) @ inverse(made.T_world_scan)
    reported: list[dict[str, Any]] = []
    for T in made.T_world_camera:
        flange = T_base_world @ T @ inverse(T_flange_camera)
        joints = postures(arm, flange)[0]
        gap = inverse(flange) @ corrected_T_base_flange(joints, flange, correction)
        reported.append({"T_base_flange": (flange @ inverse(gap)).tolist(), "joints_rad": joints.tolist()})
    mounted = {"T_flange_camera": T_flange_camera.tolist()}
    record = arm_correction_record(correction, T_flange_camera).plain()
    return T_base_world, reported, mounted | {"arm_correction": record | {"stations": [STATION]}}


@pytest.mark.slow
def test_jobs_go_from_images_to_a_gate_and_a_suggestion(
    store: Store, tmp_path: Path, pictures: tuple[Scene, list[Any]]
) -> None:
    made, images = pictures
    T_base_world, reported, hand_eye = erring_arm(made)
    np.savez(tmp_path / "mesh.npz", vertices_m=hill()[0], faces=hill()[1])
    mesh = store.put_file(tmp_path / "mesh.npz", kind="ct_mesh", media_type="application/x-npz", original_name="m")
    shared: dict[str, Any] = {
        "camera": asdict(made.camera),
        **hand_eye,
        "spheres_m": SPHERES_M.tolist(),
        "radius_m": RADIUS_M,
        "hand_eye_covariance": (np.eye(6) * 1e-12).tolist(),
        "arm_sigma_m": 1e-4,
        "arm_sigma_rad": 1e-4,
        "limits": asdict(CoverageLimits()),
    }

    def job(**arguments: Any) -> RecordedContext:
        return JobContext({**shared, **arguments}, store, tmp_path, lambda _what, _done, _total: None)

    surface = HANDLERS["coverage_points"](job(mesh=mesh.sha256)).artefacts[0].sha256
    earlier: list[str] = []
    uncorrected: list[str] = []
    errors: list[float] = []
    raw_errors: list[float] = []
    for i, image in enumerate(images):
        ok, jpeg = cv2.imencode(".jpg", image)
        assert ok
        photograph = store.put_bytes(jpeg.tobytes(), kind="image", media_type="image/jpeg", original_name=f"{i}.jpg")
        taken = {
            "viewpoint": f"v{i}",
            "station": STATION,
            "sha256": photograph.sha256,
            **reported[i],
        }
        done = HANDLERS["live_view"](job(image=taken, surface=surface if i else None, earlier=earlier))
        assert 0.0 <= done.measures["clipped_fraction"] < 0.01
        raw = (
            HANDLERS["live_view"](job(image=taken, surface=None, earlier=uncorrected, arm_correction=None))
            if i < 2
            else None
        )
        if raw is not None:
            uncorrected.append(raw.artefacts[0].sha256)
            raw_errors.append(raw.measures["predicted_target_error_mm"])
        assert done.measures["spheres_seen"] >= 6
        assert done.measures["spheres_seen"] <= done.measures["outlines"]
        earlier = [*earlier, done.artefacts[0].sha256]
        errors.append(done.measures["predicted_target_error_mm"])
    assert errors[2] < errors[0]
    last = json.loads(store.artefact_path(earlier[-1]).read_bytes())
    assert np.allclose(last["T_base_camera"], T_base_world @ made.T_world_camera[2], atol=1e-9)
    true_m = apply(T_base_world @ made.T_world_scan, SPHERES_M)
    assert np.linalg.norm(apply(np.array(last["T_base_scan"]), SPHERES_M) - true_m, axis=1).max() < 0.15e-3
    assert raw_errors[1] > 4 * errors[1], "the scatter of an arm that is not corrected shows"
    extra = scene(6, width=1000, seed=11).T_world_camera[3:]
    candidates = [
        {
            "name": f"x{i}",
            "T_base_camera": (T_base_world @ T).tolist(),
            "travel_s": 1.0,
        }
        for i, T in enumerate(extra)
    ]
    summary = HANDLERS["live_summary"](
        job(views=earlier, surface=surface, station=STATION, limit_m=1e-5, min_coverage=1.0, candidates=candidates)
    )
    assert summary.measures["predicted_target_error_mm"] == pytest.approx(errors[2], rel=1e-6)
    assert 0 < summary.measures["outline_limited_error_mm"] < summary.measures["predicted_target_error_mm"]
    assert 0 < summary.measures["specimen_coverage"] <= 1
    suggested = summary.result["next_best_views"]
    assert len(suggested) == 3
    assert suggested[0]["predicted_error_mm"] < errors[2]
    assert summary.result["reasons"] == {}


# --- runs ------------------------------------------------------------------------------------------------


@pytest.fixture
def begin(tmp_path: Path) -> Iterator[Callable[[str], Bench]]:
    with bench_store(tmp_path / "data") as opened:
        yield lambda text: begin_run(opened, text, tmp_path)


def test_a_capture_goes_on_without_numbers_where_what_they_need_was_skipped(begin: Callable[[str], Bench]) -> None:
    live = "      live: {calibration: fixation, hand_eye: fixation, spheres_of: fixation}\n"
    bench = begin(PROTOCOL.replace("      purpose: dataset\n", f"      purpose: dataset\n{live}"))
    assert bench.run().status == "completed"
    assert [note.note for note in bench.payloads(StepNote) if note.step == "capture"] == ["no_live_numbers"]


WAIT_S = 3.0  # for the last images
LIVE = f"      live: {{calibration: camera, hand_eye: camera, spheres_of: ct, wait_s: {WAIT_S}}}\n"
ENOUGH = """\
      - {measure: predicted_target_error_mm, max: 0.14, unit: mm, unless_skipped: ct}
    recovery: {retries: 2, wait_s: 0}"""


def compute_one(store: Store) -> None:
    """Compute one of the jobs that are due."""
    ends = iter((False, True))
    work(store, until_idle=True, stop=lambda: next(ends), progress=lambda _what, _done, _all: None)


def measured_run(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, folder: Path, *, held_out_mm: float,
    gates: str = ENOUGH,
) -> Bench:  # fmt: skip
    """A run whose images show the spheres exactly, with a worker beside it."""
    head, tail = PROTOCOL.split("  - id: capture\n")
    tail = tail.replace("    recovery: {retries: 2, wait_s: 0}", gates).replace("distance_m: 0.6", "distance_m: 0.85")
    tail = tail.replace("      purpose: dataset\n", f"      purpose: dataset\n{LIVE}")
    bench = begin(head + MEASURED + "  - id: capture\n" + tail)
    rig = MeasuringRig()
    rig.suite = BenchCt(folder)
    bench.rig = rig
    made = camera(1200)
    T_base_scan = transform(np.eye(3), np.array([0.0, 0.8, 0.0]))
    T_flange_camera = rig.nominal_T_flange_camera().tolist()
    hand_eye = {
        "T_flange_camera": T_flange_camera,
        "sigma": {"covariance": (np.eye(6) * 1e-12).tolist()},
        "residuals": {"held_out_mm": {"b001": held_out_mm}, "held_out_deg": {"b001": 0.001}},
        "arm_correction": None,
    }
    known: dict[str, Any] = {
        "calibrate": {
            "camera": asdict(made),
            "T_flange_camera": T_flange_camera,
            "hand_eye": hand_eye,
            "details": {},
        },
        "locate_spheres": {"spheres_m": SPHERES_M.tolist(), "details": {}},
    }
    here: list[Array] = []

    usual = HANDLERS["live_view"]

    def look(context: RecordedContext) -> JobAnswer:
        arguments = LIVE_VIEW.read_arguments(context.arguments)
        here[:] = robot_camera_poses(arguments, [arguments.image])
        return usual(context)

    def exactly(*_args: Any) -> Any:
        seen = exact_outlines(Scene(T_base_scan, np.array(here), made), 0, SPHERES_M, 0.1, margin_px=30)[0]
        return ImageOutlines(tuple(seen), None, {})

    def serve(_what: str) -> None:
        job = bench.store.claim_job("test", 30, kinds=list(known))
        if job is not None:
            bench.store.finish_job(job, measures={}, duration_s=0.1, result=known[job.kind])
        compute_jobs(bench.store)

    monkeypatch.setitem(HANDLERS, "live_view", look)
    monkeypatch.setattr("service.computations.live.compute.find_outlines", exactly)
    bench.operator.on_show = serve
    return bench


@pytest.mark.slow
def test_confirming_takes_the_suggested_views_and_the_gate_is_judged_again(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench = measured_run(begin, monkeypatch, tmp_path, held_out_mm=0.5)
    asked: list[str] = []

    def more(question: Any, _state: Any) -> Any:
        asked.append(question.text)
        return answer(question, "confirm")

    bench.script("capture", "recovery", more, more)
    state = bench.run()
    assert state.status == "completed"
    suggestions = [n.data for n in bench.payloads(StepNote) if n.note == "suggested_viewpoints"]
    assert 1 <= len(suggestions) == len(asked) <= 2
    wanted = [view["viewpoint"] for note in suggestions for view in note["viewpoints"]]
    assert wanted, "some views are suggested"
    for text, note in zip(asked, suggestions, strict=True):
        assert "Predicted error at the specimen" in text
        assert all(view["viewpoint"] in text for view in note["viewpoints"])
    assert bench.captured()[1:5] == ["v001", "v002", "v003", "v004"]
    assert sorted(bench.captured()[5:]) == sorted(wanted), "by the names that were shown, and nothing again"
    errors = [
        verdict.value or 0.0
        for gates in bench.payloads(GatesEvaluated)
        for verdict in gates.verdicts
        if verdict.measure == "predicted_target_error_mm"
    ]
    assert errors[0] > 0.14 >= errors[-1] > 0
    assert all(later < earlier for earlier, later in pairwise(errors))
    bench.must_verify()


UNEXAMINED = """\
      - {measure: images_unexamined, max: 0, unit: images, unless_skipped: ct}
    recovery: {retries: 2, wait_s: 0}"""


@pytest.mark.slow
def test_a_machine_that_is_slow_is_waited_for_while_it_goes_on_and_every_image_is_judged(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench = measured_run(begin, monkeypatch, tmp_path, held_out_mm=0.5, gates=UNEXAMINED)
    compute, at_s = bench.operator.on_show, [0.0]

    def one_job_in_two_seconds(what: str) -> None:
        now_s = bench.clock.monotonic_s()
        if now_s >= at_s[-1] + 2.0:
            compute(what)
            at_s.append(now_s)

    monkeypatch.setattr(sys.modules[__name__], "compute_jobs", compute_one)
    bench.operator.on_show = one_job_in_two_seconds
    state = bench.run()
    assert state.status == "completed"
    assert state.steps["capture"].measures["images_unexamined"] == 0
    assert bench.clock.monotonic_s() - bench.rig.shutter.arrivals_s[-1] > 2 * WAIT_S
    assert "live_numbers_late" not in [note.note for note in bench.payloads(StepNote)]


@pytest.mark.slow
def test_a_job_that_takes_long_is_waited_for_while_a_worker_computes_it(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench = measured_run(begin, monkeypatch, tmp_path, held_out_mm=0.5, gates=UNEXAMINED)
    compute, until_s = bench.operator.on_show, [0.0]

    def the_last_image_takes_long(what: str) -> None:
        if len(bench.captured()) == 5 and not until_s[0]:
            job = bench.store.claim_job("slow", 3 * WAIT_S, kinds=["live_view"])
            until_s[0] = bench.clock.monotonic_s() + 3 * WAIT_S if job is not None else 0.0
        if bench.clock.monotonic_s() >= until_s[0]:
            compute(what)

    bench.operator.on_show = the_last_image_takes_long
    state = bench.run()
    assert until_s[0]
    assert state.status == "completed"
    assert state.steps["capture"].measures["images_unexamined"] == 0
    assert "live_numbers_late" not in [note.note for note in bench.payloads(StepNote)]


@pytest.mark.slow
def test_images_that_nobody_looked_at_are_counted_and_judged_when_the_worker_is_back(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench = measured_run(begin, monkeypatch, tmp_path, held_out_mm=0.5, gates=UNEXAMINED)
    compute = bench.operator.on_show

    def not_before_they_are_late(what: str) -> None:
        late = "live_numbers_late" in [note.note for note in bench.payloads(StepNote)]
        if len(bench.captured()) < 3 or late:
            compute(what)

    def back(question: Any, _state: Any) -> Any:
        assert "Images not examined 3 images, allowed ≤ 0" in question.text
        assert "is a worker running?" in question.text
        bench.operator.on_show = compute
        return answer(question, "confirm")

    bench.operator.on_show = not_before_they_are_late
    bench.script("capture", "recovery", back)
    state = bench.run()
    assert state.status == "completed"
    assert state.steps["capture"].measures["images_unexamined"] == 0
    assert len(bench.captured()) == 5, "no image is taken again"


@pytest.mark.slow
def test_images_to_take_again_and_views_to_add_are_told_together_and_taken_by_one_confirmation(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench = measured_run(begin, monkeypatch, tmp_path, held_out_mm=0.5)
    turned = {3}  # after the board images: v002

    def exif(applied: CameraSettings) -> CameraSettings:
        return other_settings(applied) if bench.rig.shutter.exposures in turned else applied

    bench.rig.shutter.exif = exif
    asked: list[Any] = []

    def more(question: Any, _state: Any) -> Any:
        asked.append(question)
        return answer(question, "confirm")

    bench.script("capture", "recovery", more, more)
    assert bench.run().status == "completed"
    first = asked[0].text
    assert "set the camera as the protocol has it" in first
    assert "Confirm to take 1 image again; all others are kept. Predicted error at the specimen is" in first
    assert "The same confirmation also takes" in first
    note = next(n.data for n in bench.payloads(StepNote) if n.note == "suggested_viewpoints")
    wanted = [view["viewpoint"] for view in note["viewpoints"]]
    assert all(name in first for name in wanted)
    assert note["images"] == 1
    assert set(bench.captured()[5 : 6 + len(wanted)]) == {"v002", *wanted}
    bench.must_verify()


def test_without_the_ct_there_is_no_number_and_no_gate_on_it(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench = measured_run(begin, monkeypatch, tmp_path, held_out_mm=0.5)
    assert isinstance(bench.rig, MeasuringRig)
    bench.rig.suite.works = False
    bench.script("ct", "recovery", lambda question, _state: answer(question, "skip", reason="the scanner is down"))
    state = bench.run()
    assert state.status == "completed"
    (gates,) = [g for g in bench.payloads(GatesEvaluated) if g.step == "capture"]
    assert gates.passed
    assert "predicted_target_error_mm" not in [v.measure for v in gates.verdicts]
    assert [note.note for note in bench.payloads(StepNote) if note.step == "capture"] == ["no_live_numbers"]
    assert [d.kind for d in state.deviations] == ["skip"]
    assert any("no numbers while capturing" in line for line in bench.operator.told)


def test_an_operator_is_told_what_is_missing_and_what_would_help(begin: Callable[[str], Bench]) -> None:
    gate = "      - {measure: predicted_target_error_mm, max: 0.3, unit: mm}\n    recovery: {retries: 2, wait_s: 0}"
    bench = begin(PROTOCOL.replace("    recovery: {retries: 2, wait_s: 0}", gate))
    advice = "Confirm to take 1 more views (vt25+40)"

    def told(question: Any, _state: Any) -> Any:
        assert "Predicted error at the specimen was not measured, allowed ≤ 0.3" in question.text
        assert advice in question.text
        return answer(question, "abort", reason="seen enough")

    def suggest(moves: int) -> None:
        if moves == 4:
            data = {"advice": advice, "viewpoints": [{"viewpoint": "vt25+40"}]}
            note = StepNote(step="capture", attempt=1, note="suggested_viewpoints", data=data)
            bench.store.record(bench.run_id, [note], actor="runner")

    bench.rig.arm.on_move = suggest
    bench.script("capture", "recovery", told)
    assert bench.run().status == "aborted"


@pytest.mark.slow
def test_an_image_that_is_judged_late_is_taken_again_and_one_that_is_spoilt_again_is_not(
    begin: Callable[[str], Bench], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench = measured_run(begin, monkeypatch, tmp_path, held_out_mm=0.5, gates=UNEXAMINED)
    compute, usual = bench.operator.on_show, HANDLERS["live_view"]
    looked_at: list[str] = []

    def look(context: RecordedContext) -> JobAnswer:
        """Judge both images of v001 black, and the first of v003."""
        answer = usual(context)
        name = LIVE_VIEW.read_arguments(context.arguments).image.viewpoint
        looked_at.append(name)
        black = name == "v001" or (name == "v003" and looked_at.count(name) == 1)
        return replace(answer, answer=answer.answer.model_copy(update={"black": black}))

    def at_first_only_two_images(what: str) -> None:
        late = "live_numbers_late" in [note.note for note in bench.payloads(StepNote)]
        if len(bench.captured()) < 3 or late:
            compute(what)

    monkeypatch.setitem(HANDLERS, "live_view", look)
    bench.operator.on_show = at_first_only_two_images
    assert bench.run().status == "completed"
    taken = bench.captured()[1:]
    assert taken == ["v001", "v002", "v003", "v004", "v001", "v003"]
    announced = [line for line in bench.operator.told if "taken again" in line]
    assert [line.partition(":")[0] for line in announced] == ["v001", "v003"]
