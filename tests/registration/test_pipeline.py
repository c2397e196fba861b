"""From image files to a registration: the stand-alone pipeline."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.compute.camera_model import CameraModel
from service.compute.images.photographs import read_image
from service.compute.markers.image_files import detect_all
from service.compute.markers.records import SphereOutline
from service.compute.pipeline import draw_overlay, register_images
from service.compute.registration.accuracy import true_error_m
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import DataError
from service.core.geometry import inverse
from tests.support.scenes.sphere_images import CONTROL_M, RADIUS_M, REGISTRATION_M, Scene, render, scene

Captured = tuple[Scene, list[Path], tuple[tuple[SphereOutline, ...], ...]]


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Captured:
    folder = tmp_path_factory.mktemp("images")
    made = scene(6, 1024, seed=11)
    everything = np.vstack([REGISTRATION_M, CONTROL_M])
    paths: list[Path] = []
    for i in range(6):
        path = folder / f"view_{i}.jpg"
        picture = render(made.camera, made.centres_camera(i, everything), i, oversample=3)
        assert cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])
        paths.append(path)
    seen: list[tuple[int, int]] = []
    outlines = detect_all(paths, made.camera, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(k, 6) for k in range(1, 7)]
    return made, paths, outlines


@pytest.mark.parametrize("scale", [1.0, 4.2])
def test_files_to_registration(captured: Captured, scale: float) -> None:
    made, paths, outlines = captured
    poses = np.array(made.T_world_camera)
    poses[:, :3, 3] /= scale
    result = register_images(
        outlines,
        PosedImages(poses, made.camera, metric=scale == 1.0, names=[p.name for p in paths]),
        ScanSpheres(REGISTRATION_M, RADIUS_M, control_m=CONTROL_M),
    )
    truth = inverse(made.T_world_scan) @ made.T_world_camera
    assert true_error_m(result.registration.T_scan_camera, truth, np.array([0, 0, 0.05])) < 3e-5
    assert result.registration.scale == pytest.approx(scale, rel=1e-3)
    assert result.evaluation is not None
    assert result.evaluation.mean_radial_error_mm < 0.08
    assert result.evaluation.mean_reprojection_error_px < 0.25
    data = json.loads(json.dumps(result.as_json(made.camera)))
    assert data["n_images"] >= 5
    assert len(data["images"]) == 6
    assert np.array(data["T_world_scan"]).shape == (4, 4)
    controls = [d["control"] for entry in data["images"] for d in entry["detections"] if d["control"] is not None]
    assert set(controls) == {0, 1, 2}
    assert all(d["marker"] is None or d["control"] is None for e in data["images"] for d in e["detections"])


def test_overlay_draws_on_a_copy(captured: Captured) -> None:
    made, paths, outlines = captured
    result = register_images(
        outlines, PosedImages(made.T_world_camera, made.camera), ScanSpheres(REGISTRATION_M, RADIUS_M)
    )
    image = read_image(paths[0])
    before = image.copy()
    entry = result.images[0]
    picture = draw_overlay(
        image, made.camera, entry.detections, T_scan_camera=entry.T_scan_camera,
        registration_centres_m=REGISTRATION_M, control_centres_m=CONTROL_M, radius_m=RADIUS_M,
    )  # fmt: skip
    assert np.array_equal(image, before)
    changed = np.any(picture != image, axis=2)
    assert 0.001 < changed.mean() < 0.2


@pytest.mark.slow
def test_half_a_jpeg_is_refused_by_name(captured: Captured, tmp_path: Path) -> None:
    made, paths, _ = captured
    data = paths[0].read_bytes()
    for part in (0.3, 0.9, 1 - 2 / len(data)):
        cut = tmp_path / "cut.jpg"
        cut.write_bytes(data[: int(len(data) * part)])
        with pytest.raises(DataError, match=r"complete.*cut\.jpg"):
            detect_all([paths[1], cut], made.camera)
    zeros = tmp_path / "zeros.jpg"
    zeros.write_bytes(data[: len(data) // 2] + bytes(len(data) - len(data) // 2))
    with pytest.raises(DataError, match=r"zeros\.jpg"):
        detect_all([zeros], made.camera)
    whole = tmp_path / "preview_behind.jpg"
    whole.write_bytes(data + b"maker's preview")
    assert read_image(whole).shape == (made.camera.height, made.camera.width, 3)


def test_other_bad_files(captured: Captured, tmp_path: Path) -> None:
    made = captured[0]
    with pytest.raises(DataError, match=r"missing\.jpg"):
        detect_all([tmp_path / "missing.jpg"], made.camera)
    text = tmp_path / "text.png"
    text.write_text("no picture")
    with pytest.raises(DataError, match=r"text\.png"):
        read_image(text)
    small = tmp_path / "small.png"
    assert cv2.imwrite(str(small), np.zeros((50, 60, 3), np.uint8))
    with pytest.raises(DataError, match=r"60×50.*small\.png"):
        detect_all([small], made.camera)


def test_orientation_tag_is_ignored(tmp_path: Path) -> None:
    ok, data = cv2.imencode(".jpg", np.zeros((40, 60, 3), np.uint8))
    assert ok
    raw = data.tobytes()
    tiff = b"II*\x00\x08\x00\x00\x00\x01\x00\x12\x01\x03\x00\x01\x00\x00\x00\x06\x00\x00\x00\x00\x00\x00\x00"
    exif = b"Exif\x00\x00" + tiff
    segment = b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    turned = tmp_path / "turned.jpg"
    turned.write_bytes(raw[:2] + segment + raw[2:])
    assert read_image(turned).shape == (40, 60, 3)


def test_lengths_must_agree(captured: Captured) -> None:
    made, _, outlines = captured
    with pytest.raises(DataError, match="poses"):
        register_images(
            outlines, PosedImages(made.T_world_camera[:3], made.camera), ScanSpheres(REGISTRATION_M, RADIUS_M)
        )


def test_camera_is_needed_at_the_images_size() -> None:
    assert CameraModel(100, 60, 100, 100, 50, 30).scaled(50, 30).cx == pytest.approx(24.75)
