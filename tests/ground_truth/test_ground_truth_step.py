"""The step that fuses CT and scan in a run: frames, measures, files, the wound, and a run without a CT."""

from __future__ import annotations

import base64
import json
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.interfaces import CtSource, DeviceIdentity, DeviceReport, Mesh, ScanExport, ScannedMesh, Scanner
from service.computations.job import JobContext
from service.compute.surfaces.surface import Surface, read_ply
from service.core.errors import ProtocolError
from service.core.geometry import inverse, transform
from service.core.protocol import parse_protocol
from service.core.records.run_events import RegionDrawn
from service.core.run.state import RunState
from service.core.words import SIMULATED
from service.dataset.preview import SimplifiedMesh, fused_mesh, shown_distances
from service.dataset.run_data_set import about_run
from service.dataset.summary import recorded_fusion, summarise
from service.steps import params_models
from service.worker.loop import HANDLERS
from tests.support.ct.fused_scene import CENTRES_M, RADIUS_M, T_WORLD_CT, ct_mesh, height, scan_mesh, with_spheres
from tests.support.recorded.registration_record import registration_record
from tests.support.rig.bench_rig import BenchRig, ScriptedOperator, answer
from tests.support.runs.bench_run import Bench, bench_store
from tests.support.runs.computing_run import begin_computing_run

TAKEN_M = np.array([0.018, 0.012, 0.0360])  # a control sphere on the specimen, which the scan does not show
PROTOCOL = """\
id: truth
version: "1"
title: A CT and a scan
spheres: {radius_mm: 6, registration: 5, control: 1}
camera: {aperture_f: 22, exposure_s: 1/50, iso: 100}
steps:
  - id: ct
    kind: ct_import
    title: CT
    params: {source: mesh, spheres: 6, wait_s: 5}
    skippable: true
  - id: scan
    kind: scan_import
    title: Scan
    confirm: false
    params: {spheres: 5, wait_s: 5}
  - id: ground_truth
    kind: ground_truth
    title: Fuse
    confirm: false
    params:
      ct: ct
      scan: scan
      chamfer_spacing_mm: 0.5
      wound:
        - {source: ct, frame: scan, centre_mm: [-20, -15, 30], size_mm: [6, 6, 20]}
    gates:
      - {measure: sphere_distance_change_max_mm, max: 0.3, unit: mm, unless_skipped: ct}
      - {measure: folded_faces, max: 0, unit: faces, unless_skipped: ct}
"""


class Shelf:
    """A scanner, or a CT suite, with one mesh."""

    def __init__(self, file: Path, mesh: Surface) -> None:
        self.file, self.mesh = file, mesh
        file.write_bytes(b"as it was exported")

    def report(self) -> DeviceReport:
        return DeviceReport(DeviceIdentity("shelf", "Bench shelf", "S-1", "1.0", "bench", "1", "memory"))

    def exports(self) -> tuple[ScanExport, ...]:
        return (ScanExport("mesh", (self.file,), "2036-11-21T10:00:00Z"),)

    segmented_meshes = exports

    def read(self, export: ScanExport) -> ScannedMesh:
        vertices_m, faces = self.mesh.vertices_m, self.mesh.faces
        return ScannedMesh(
            Mesh(vertices_m, faces.astype(np.int32), np.zeros_like(vertices_m)), "m", "known", {}, export
        )

    read_mesh = read


class TwoSurfaces(BenchRig):
    """The bench with a scanner and a CT suite."""

    shelf: Shelf
    suite: Shelf

    def scanner(self, name: str | None = None) -> Scanner:
        return cast(Scanner, self.shelf)

    def ct(self) -> CtSource:
        return cast(CtSource, self.suite)


@contextmanager
def begun(tmp_path: Path) -> Generator[Bench]:
    """A run of the protocol that has not begun yet."""
    rig = TwoSurfaces()
    rig.shelf = Shelf(tmp_path / "scan.ply", with_spheres(scan_mesh(), CENTRES_M))
    in_ct = with_spheres(ct_mesh(), np.vstack([CENTRES_M, TAKEN_M]))
    rig.suite = Shelf(tmp_path / "ct.stl", in_ct.moved(inverse(T_WORLD_CT)))
    with bench_store(tmp_path / "data") as store:
        yield begin_computing_run(store, PROTOCOL, tmp_path, rig)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    with begun(tmp_path) as made:
        yield made


@pytest.fixture(scope="module")
def fused_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """A run that is completed, for the tests that only read it."""
    with begun(tmp_path_factory.mktemp("fused")) as made:
        made.run()
        yield made


def fused(bench: Bench) -> tuple[RunState, dict[str, Any], np.ndarray[Any, Any]]:
    """The state of a completed run, the fused mesh's properties, and its vertices in metres."""
    state = bench.state()
    assert state.status == "completed", state
    (mesh,) = (ref for ref in state.steps["ground_truth"].artefacts if ref.kind == "ground_truth_mesh")
    columns, faces = read_ply(bench.store.artefact_path(mesh.sha256))
    points = 1e-3 * np.stack([np.asarray(columns[axis], dtype=np.float64) for axis in "xyz"], axis=1)
    assert faces.max() < len(points)
    return state, dict(columns), points


@pytest.mark.slow
def test_a_run_with_a_ct_and_a_scan_makes_the_ground_truth(fused_run: Bench) -> None:
    state, columns, points = fused(fused_run)
    measures = state.steps["ground_truth"].measures
    assert measures["spheres_compared"] == len(CENTRES_M)
    assert measures["sphere_distance_change_max_mm"] < 0.02
    assert measures["folded_faces"] == 0
    assert measures["chamfer_floor_mm"] < measures["chamfer_ct_scan_mm"]
    assert "loop_closure_mm" not in measures  # there are no images
    details = state.steps["ground_truth"].result["details"]
    assert np.array(details["T_scan_ct"]) == pytest.approx(T_WORLD_CT, abs=2e-5)
    assert len(details["wound_m"]) >= 3
    assert [(r["by"], r["source"]) for r in details["regions"]] == [("protocol truth 1", "ct")]
    assert set(np.unique(columns["source"])) == {0, 1, 2}
    assert np.all(columns["sigma_mm"] > 0)
    boxed = np.all(np.abs(points - [-0.020, -0.015, 0.030]) < [0.0028, 0.0028, 0.0098], axis=1)
    assert np.all(columns["source"][boxed] == 0)
    picture = next(ref for ref in state.steps["ground_truth"].artefacts if ref.kind == "fusion_picture")
    shown = cv2.imread(str(fused_run.store.artefact_path(picture.sha256)))
    assert shown is not None
    assert shown.std() > 10
    fused_run.must_verify()


@pytest.mark.slow
def test_the_screen_shows_sources_and_sigmas_and_the_recorded_distances(fused_run: Bench, tmp_path: Path) -> None:
    state, columns, points = fused(fused_run)
    loaded = parse_protocol(PROTOCOL.encode(), params_models(), name="truth.yaml")
    summary = summarise(fused_run.store, fused_run.run_id, loaded.protocol)
    fusion = recorded_fusion(summary)
    assert fusion is not None
    exported = summary.ground_truth().mesh
    assert exported.source is not None
    assert np.array_equal(exported.source, columns["source"])
    assert exported.sigma_m == pytest.approx(1e-3 * columns["sigma_mm"], rel=1e-6)
    mesh = SimplifiedMesh(
        points, read_ply(fused_run.store.artefact_path(fusion.files["ground_truth_mesh"].sha256))[1]
    )
    truth, measures = fused_mesh(tmp_path, summary, fusion, mesh), state.steps["ground_truth"].measures
    assert (truth.ct_share, truth.sigma_median_mm) == (measures["ct_share"], measures["sigma_median_mm"])
    assert truth.ct_share + truth.scan_share + truth.blend_share == pytest.approx(1)
    assert (truth.loop_closure_mm, truth.faces) == (None, measures["ground_truth_faces"])
    assert [(region.source, region.by) for region in truth.regions] == [("ct", "protocol truth 1")]
    sources, sigmas = (drawn(tmp_path / name) for name in (truth.sources, truth.sigmas))
    assert sources["colorbar"]["ticktext"] == ["CT", "blend", "scan"]
    assert unpacked(sources["intensity"]) == pytest.approx(
        np.array([0, 2, 1])[columns["source"][mesh.triangles[:, 0]]]
    )
    assert unpacked(sigmas["intensity"]) == pytest.approx(
        np.minimum(columns["sigma_mm"], truth.sigma_high_mm), rel=1e-6
    )
    card = dict(about_run(summary, "spheres").fusion)
    assert f"{measures['chamfer_ct_scan_mm']:.3f} mm" in card["Chamfer distance of CT and scan"]
    assert "0.5 mm" in card["Chamfer distance of CT and scan"]
    assert card["Wound"] == "proposed, then corrected: CT by protocol truth 1"
    distances = shown_distances(tmp_path, summary, fusion)
    recorded = ("chamfer_ct_scan_mm", "ct_to_scan_mm", "scan_to_ct_median_mm", "spheres_rms_mm")
    told = (distances.chamfer_mm, distances.ct_to_scan_mm, distances.scan_to_ct_median_mm, distances.spheres_rms_mm)
    assert told == tuple(measures[name] for name in recorded)
    assert (distances.step, distances.spacing_mm) == ("Fuse", 0.5)
    off = unpacked(drawn(tmp_path / distances.figure)["intensity"])
    assert 0.05 < float(np.median(off)) < 0.5  # the samples are 0.5 mm apart or more


def drawn(path: Path) -> dict[str, Any]:
    """The surface in a figure."""
    (mesh, *_) = json.loads(path.read_text(encoding="utf-8"))["data"]
    return cast(dict[str, Any], mesh)


def unpacked(packed: dict[str, str]) -> np.ndarray[Any, Any]:
    """An array as plotly has it in base64."""
    return np.frombuffer(base64.b64decode(packed["bdata"]), dtype=packed["dtype"])


@pytest.mark.slow
def test_a_region_that_a_person_drew_is_used_with_the_name(bench: Bench) -> None:
    corners = ((-0.022, 0.012, 0.03), (-0.016, 0.012, 0.03), (-0.016, 0.018, 0.03), (-0.022, 0.018, 0.03))
    drawn = RegionDrawn(step="ground_truth", source="ct", corners_m=corners, seen_along=(0.0, 0.0, 1.0))
    elsewhere = drawn.model_copy(update={"step": "another"})
    bench.store.record(bench.run_id, [drawn, elsewhere], actor="grace")
    bench.run()
    state, columns, points = fused(bench)
    regions = state.steps["ground_truth"].result["details"]["regions"]
    assert [(r["by"], r["frame"]) for r in regions] == [("protocol truth 1", "scan"), ("grace", "scan")]
    loaded = parse_protocol(PROTOCOL.encode(), params_models(), name="truth.yaml")
    summary = summarise(bench.store, bench.run_id, loaded.protocol)
    told = [dict(about_run(summary, "", personal=personal).fusion)["Wound"] for personal in (True, False)]
    assert [("by grace" in words, "who is not named" in words) for words in told] == [(True, False), (False, True)]
    within = np.all(np.abs(points[:, :2] - [-0.019, 0.015]) < 0.0028, axis=1) & (points[:, 2] > 0.02)
    assert within.any()
    assert np.all(columns["source"][within] == 0)


def test_a_sphere_that_was_taken_away_before_the_scan_is_not_in_the_ground_truth(fused_run: Bench) -> None:
    state, _, points = fused(fused_run)
    (number,) = state.steps["ground_truth"].result["details"]["taken_away"]
    in_ct = np.array(state.steps["ct"].result["spheres_m"][number])
    assert T_WORLD_CT[:3, :3] @ in_ct + T_WORLD_CT[:3, 3] == pytest.approx(TAKEN_M, abs=1e-4)
    above = points[np.linalg.norm(points - TAKEN_M, axis=1) < RADIUS_M + 0.0008]
    assert len(above) > 20  # the scan's surface, which the sphere nearly touched
    assert above[:, 2] == pytest.approx(height(above[:, 0], above[:, 1]), abs=1e-4)


@pytest.mark.slow
def test_without_a_ct_the_step_says_so_and_passes(bench: Bench) -> None:
    operator = ScriptedOperator()
    operator.script = {("ct", "confirm"): [lambda q, _s: answer(q, "skip", reason="there is none")]}
    bench.operator = operator
    state = bench.run()
    assert state.status == "completed"
    assert state.steps["ground_truth"].result["without"] == "ct"
    assert not state.steps["ground_truth"].artefacts


@pytest.mark.slow
def test_the_way_through_the_cameras_is_compared_with_the_spheres(fused_run: Bench, tmp_path: Path) -> None:
    (job,) = (j for j in fused_run.state().steps["ground_truth"].jobs.values() if j.kind == "fuse")
    steps = fused_run.state().steps
    off = transform(Rotation.identity(), np.array([2e-4, 0.0, 0.0]))
    T_world_scan = transform(Rotation.from_rotvec([0.1, 0.2, 0.3]), np.array([1.0, 0.0, 0.5]))
    arguments = {
        **job.arguments,
        "ct": dict(steps["ct"].result),
        "scan": dict(steps["scan"].result),
        "scan_registration": registration_record("robot", T_world_scan=T_world_scan.tolist()),
        "ct_registration": registration_record("robot", T_world_scan=(T_world_scan @ off @ T_WORLD_CT).tolist()),
        "regions": [
            {
                "source": "ct",
                "frame": "world",
                "by": "A. Surgeon",
                "corners_m": [
                    (T_world_scan[:3, :3] @ p + T_world_scan[:3, 3]).tolist()
                    for p in ([-0.020, 0.012, 0.03], [-0.012, 0.012, 0.03], [-0.016, 0.020, 0.03])
                ],
                "below_m": 0.01,
                "above_m": 0.01,
            }
        ],
    }
    done = HANDLERS["fuse"](JobContext(arguments, fused_run.store, tmp_path, lambda *_: None))
    assert done.measures["loop_closure_mm"] == pytest.approx(0.2, abs=0.03)
    assert done.measures["loop_closure_rms_mm"] == pytest.approx(0.2, abs=0.03)
    columns, _ = read_ply(fused_run.store.artefact_path(done.artefacts[0].sha256))
    x, y, z = (np.asarray(columns[axis], dtype=np.float64) for axis in "xyz")
    middle = (np.hypot(x + 16, y - 14.5) < 1.5) & (z > 25)
    assert middle.any()
    assert np.all(columns["source"][middle] == 0)


@pytest.mark.slow
def test_the_meshes_of_a_simulated_run_say_so_and_those_of_earlier_versions_are_as_they_were(
    fused_run: Bench, tmp_path: Path
) -> None:
    steps = fused_run.state().steps
    (job,) = (j for j in steps["ground_truth"].jobs.values() if j.kind == "fuse")
    earlier = {**job.arguments, "ct": dict(steps["ct"].result), "scan": dict(steps["scan"].result)}
    assert earlier.pop("simulated") is True
    before = HANDLERS["fuse"](JobContext(earlier, fused_run.store, tmp_path, lambda *_: None))
    line = b"comment " + SIMULATED.encode("ascii") + b"\n"
    files = [
        [fused_run.store.artefact_path(ref.sha256).read_bytes() for ref in refs if ref.media_type == "model/ply"]
        for refs in (job.artefacts, before.artefacts)
    ]
    assert [len(each) for each in files] == [2, 2]
    for now, as_it_was in zip(*files, strict=True):
        assert now.count(line) == 1
        assert now.replace(line, b"") == as_it_was


def test_a_region_is_a_polygon_or_a_box() -> None:
    wrong = PROTOCOL.replace("centre_mm: [-20, -15, 30], size_mm: [6, 6, 20]", "corners_mm: [[0, 0, 0], [1, 0, 0]]")
    with pytest.raises(ProtocolError, match="polygon of at least three"):
        parse_protocol(wrong.encode(), params_models(), name="truth.yaml")
