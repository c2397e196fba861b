"""`orthocapture export` of a recorded run: what it writes, what it records, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from service.audit.recorded_run import read_run
from service.cli.main import app
from service.compute.images.render import WorldSphere, marker_mask
from service.core.geometry import apply, increment, inverse
from service.core.records.run_events import EvidenceExported, RunCompleted, RunReleased
from service.core.units import metres
from service.dataset.records import Mesh
from service.dataset.run_data_set import control_spheres, data_set_of, specimen_pixels, upwards
from service.dataset.view_covariances import pose_covariance
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.record.outsider import copy_data, tamper
from tests.support.recorded.reported_run import record_reported_run
from tests.support.recorded.unpacked_run import unpack_recorded_run
from tests.support.runs.bench_run import record_runs

pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return unpack_recorded_run(tmp_path_factory.mktemp("recorded"))


def export(data: Path, *arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["export", "latest", "--data", str(data), *arguments])
    return result.exit_code, result.output


@pytest.mark.slow
def test_a_run_is_exported_recorded_and_still_verifies(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "colmap"
    status, printed = export(recorded, "--format", "colmap", "--out", str(out), "--operator", "Erika", "--json")
    assert status == 0, printed
    run = read_run(recorded, "latest")
    dataset = data_set_of(run.summary())
    assert json.loads(printed)["images"] == len(dataset.views)
    event = run.events[-1]
    assert isinstance(event.payload, EvidenceExported)
    assert (event.payload.what, event.payload.file_name, event.actor) == ("dataset", "colmap", "Erika")
    assert verify(recorded).ok
    described = json.loads((out / "dataset.json").read_text())
    assert described["simulated"] is True
    assert described["pose_source"] == run.summary().best()
    # Its scan was cut to the spheres.
    assert described["masks"].startswith("13 spheres, and the posts below 10 of them, down to the table")
    # The spheres are in the images where pycolmap projects them: they differ from what surrounds them.
    model = pycolmap.Reconstruction(str(out / "sparse" / "0"))
    spheres = np.array(run.summary().scan_spheres_m())
    views = {view.file: view for view in dataset.views}
    for image in model.images.values():
        for centre in spheres:
            pixel = image.project_point(centre)
            ours = views[image.name].camera.project(apply(inverse(views[image.name].T_world_camera), centre[None]))[0]
            assert pixel is None or np.abs(pixel - 0.5 - ours).max() < 0.01


@pytest.mark.slow
def test_an_anonymous_export_has_none_of_the_scanners_own_files(recorded: Path, tmp_path: Path) -> None:
    for options, held in (((), True), (("--anonymous",), False)):
        out = tmp_path / f"plain{len(options)}"
        status, printed = export(recorded, "--format", "plain", "--out", str(out), *options)
        assert status == 0, printed
        assert (out / "scan").exists() == held
        assert (out / "mesh.ply").is_file()


def test_the_masks_cover_the_spheres_that_the_photographs_show(recorded: Path) -> None:
    """Within the mask of a sphere the colour differs from that around it: mask, pose and pixels belong together."""
    run = read_run(recorded, "latest")
    dataset, radius_m = data_set_of(run.summary()), metres(run.protocol.spheres.radius_mm)
    spheres = run.summary().scan_spheres_m()
    contrast: list[float] = []
    for view in dataset.views:
        saturation = cv2.cvtColor(dataset.pixels.colours(view), cv2.COLOR_BGR2HSV)[..., 1].astype(np.float64)
        for centre in spheres:
            mine = marker_mask(view.camera, view.T_world_camera, [WorldSphere(np.array(centre), 0.9 * radius_m)])
            around = marker_mask(view.camera, view.T_world_camera, [WorldSphere(np.array(centre), 1.5 * radius_m)])
            around &= ~marker_mask(view.camera, view.T_world_camera, [WorldSphere(np.array(centre), 1.15 * radius_m)])
            if mine.sum() > 50 and around.sum() > 50:
                contrast.append(abs(float(np.median(saturation[mine]) - np.median(saturation[around]))))
    assert len(contrast) > 10
    assert np.median(contrast) > 20


def test_control_spheres_that_the_scan_no_longer_shows_are_masked(recorded: Path) -> None:
    """They are yellow-green as the others, and stand on the specimen, whose colour differs."""
    summary = read_run(recorded, "latest").summary()
    dataset, centres = data_set_of(summary), control_spheres(summary)
    assert len(centres) == summary.protocol.spheres.control
    for view in dataset.views:
        colours, markers = dataset.pixels.colours(view).astype(np.int64), dataset.pixels.markers(view)
        between = specimen_pixels(summary, view)
        sphere_like = (colours[..., 1] > 120) & (colours[..., 1] > 1.5 * colours[..., 0]) & between
        assert np.count_nonzero(sphere_like) > 300
        assert np.count_nonzero(sphere_like & ~markers) < 0.06 * np.count_nonzero(sphere_like)


@pytest.mark.slow
def test_crops_of_a_run_are_free_of_markers(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "crops"
    status, printed = export(
        recorded, "--format", "nerfstudio", "--out", str(out), "--crop", "96x64", "--anonymous", "--json"
    )
    assert status == 0, printed
    stated = json.loads((out / "transforms.json").read_text())
    assert len(stated["frames"]) == json.loads(printed)["images"] > 0
    for frame in stated["frames"]:
        mask = cv2.imread(str(out / frame["mask_path"]), cv2.IMREAD_GRAYSCALE)
        assert mask is not None
        assert mask.shape == (64, 96)
        assert mask.all()


def test_an_export_of_altered_evidence_is_refused(recorded: Path, tmp_path: Path) -> None:
    run = read_run(recorded, "latest")
    photograph = next(c for c in run.summary().captures() if c.artefacts[0].kind == "image").artefacts[0]
    path = run.files.artefact_path(photograph.sha256)
    whole, mode = path.read_bytes(), path.stat().st_mode
    path.chmod(0o644)
    try:
        path.write_bytes(whole[:-9] + b"forged" + whole[-3:])
        status, printed = export(recorded, "--format", "gltf", "--out", str(tmp_path / "out"))
    finally:
        path.write_bytes(whole)
        path.chmod(mode)
    assert status != 0
    assert "does not verify" in printed
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    "statement",
    [
        "DELETE FROM checkpoints",
        "DELETE FROM checkpoints WHERE seq = (SELECT max(seq) FROM checkpoints)",
        "UPDATE checkpoints SET signature = 'AAAA'",
        "UPDATE events SET actor = 'Eve' WHERE seq = 3",
    ],
)
def test_an_export_without_its_signatures_is_refused(recorded: Path, tmp_path: Path, statement: str) -> None:
    copy_data(recorded, tmp_path / "data")
    tamper(tmp_path / "data", statement)
    status, printed = export(tmp_path / "data", "--format", "gltf", "--out", str(tmp_path / "out"), "--json")
    assert status != 0
    assert json.loads(printed.splitlines()[-1])["error"]["kind"] == "IntegrityError"
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_an_export_without_the_second_persons_release_is_refused(tmp_path: Path) -> None:
    run_id = record_reported_run(tmp_path, release="second_person", registered=True)
    out = tmp_path / "out"
    status, printed = export(tmp_path / "data", "--format", "gltf", "--out", str(out))
    assert status != 0
    assert "second person's release" in printed
    assert not list(tmp_path.glob("*out*"))
    with Store.open(tmp_path / "data") as store:
        completed = next(e for e in store.events(run_id) if isinstance(e.payload, RunCompleted))
        store.record(run_id, [RunReleased(meaning="read", signed_sha256=completed.sha256)], actor="Grace")
    status, printed = export(tmp_path / "data", "--format", "gltf", "--out", str(out))
    assert status == 0, printed
    assert (out / "scene.glb").is_file()


def test_what_the_options_state_stands_in_the_metadata(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "stated"
    status, printed = export(
        recorded,
        *("--format", "gltf", "--out", str(out), "--title", "A spine", "--licence", "CC-BY-4.0"),
        *("--ethics", "Waived, 2026-7", "--creator", "A. Name", "--creator", "B. Name", "--cite", "Name, 2026."),
        *("--data-version", "2.1.0", "--anonymous", "--doi", "doi:10.5281/zenodo.1", "--publisher", "A press"),
        *("--funder", "A fund https://ror.org/05a28rw58"),
    )
    assert status == 0, printed
    card = (out / "DATACARD.md").read_text(encoding="utf-8")
    for words in ("# A spine", "CC-BY-4.0", "Waived, 2026-7", "A. Name, B. Name", "Name, 2026.", "Version 2.1.0"):
        assert words in card
    crate = json.loads((out / "ro-crate-metadata.json").read_text())
    # Those who are stated as makers are named; those who took part in the run are not.
    assert {e["name"] for e in crate["@graph"] if e["@type"] == "Person"} == {"A. Name", "B. Name"}
    assert {e["serialNumber"] for e in crate["@graph"] if e["@type"] == "IndividualProduct"} == {""}
    assert "serial number" not in card


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--format", "gltf", "--data-version", "one"), "'one' is not a version"),
        (("--format", "nonsense"), "there is no format 'nonsense'"),
        (("--format", "gltf", "--crop", "wide"), "'wide' is not a size"),
        (("--format", "gltf", "--crop", "99999x10"), "does not fit"),
        (("--format", "gltf", "--crops", "2"), "1920 × 1080 px does not fit"),
        (("--format", "gltf", "--creator", "A. Name 0000-0002-1825-0098"), "check digit is wrong"),
        (("--format", "gltf", "--licence", "CC BY 4.0"), "Did you mean CC-BY-4.0"),
        (("--format", "gltf", "--funder", "ETH ror.org/05a28rw59"), "the ROR is mistyped"),
        (("--format", "gltf", "--doi", "zenodo.1"), "this is not a DOI"),
    ],
)
def test_what_cannot_be_is_refused(recorded: Path, tmp_path: Path, arguments: tuple[str, ...], words: str) -> None:
    status, printed = export(recorded, "--out", str(tmp_path / "out"), *arguments)
    assert status != 0
    assert words in printed
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_is_not_complete_is_not_exported(tmp_path: Path) -> None:
    record_runs(tmp_path)
    status, printed = export(tmp_path / "data", "--format", "gltf", "--out", str(tmp_path / "out"))
    assert status != 0
    assert "Only a completed run is exported" in printed
    assert {path.name for path in tmp_path.iterdir() if "out" in path.name} == set()


def test_the_covariance_of_a_pose_is_that_of_the_registration_seen_from_the_scan(recorded: Path) -> None:
    run = read_run(recorded, "latest")
    own = run.summary().best()
    assert own is not None
    registered = run.summary().registrations()[own]
    T_world_scan, T_scan_camera = (
        np.array(registered.T_world_scan),
        np.array(next(iter(registered.T_scan_camera.values()))),
    )
    covariance = np.array(registered.covariance)[:6, :6]
    rng = np.random.default_rng(3)
    draws = rng.multivariate_normal(np.zeros(6), covariance, 20_000)
    moved: list[np.ndarray[tuple[int, ...], np.dtype[np.float64]]] = []
    for draw in draws[:4000]:
        T = inverse(increment(T_world_scan, draw[:3], draw[3:])) @ T_world_scan @ T_scan_camera
        turn = T[:3, :3] @ T_scan_camera[:3, :3].T
        w = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        moved.append(np.concatenate([T[:3, 3] - T_scan_camera[:3, 3], w]))
    seen = np.cov(np.array(moved).T)
    stated = pose_covariance(T_world_scan, covariance, T_scan_camera)
    scale = np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
    assert np.abs((seen - stated) / scale).max() < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_up_is_the_normal_of_the_board_however_the_scan_lies(seed: int) -> None:
    rng = np.random.default_rng(seed)
    board = trimesh.creation.box(bounds=[[-0.2, -0.15, -0.02], [0.2, 0.15, 0.0]]).subdivide().subdivide()
    specimen = trimesh.creation.icosphere(subdivisions=4, radius=0.09)
    vertices = np.concatenate([board.vertices, specimen.vertices])
    faces = np.concatenate([board.faces, specimen.faces + len(board.vertices)])
    R = Rotation.random(rng=rng).as_matrix()
    about = R @ np.array([0.4 * np.cos(seed), 0.4 * np.sin(seed), 0.9])  # cameras at one side
    up = upwards(Mesh(vertices @ R.T + rng.uniform(-1, 1, 3), faces), about)
    assert up @ R[:, 2] > np.cos(np.radians(0.5))
