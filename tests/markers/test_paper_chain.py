"""The paper's detector finds the spheres, with its own boxes or those of another detector."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.compute.markers.detect import DETECTORS
from service.compute.markers.paper import (
    detect_by_masks,
    detect_file_by_masks,
    find_boxes,
    fit_ellipse,
    read_boxes,
    sphere_mask,
)
from service.core.errors import DataError
from tests.support.scenes.sphere_images import CONTROL_M, REGISTRATION_M, exact_outlines, render, scene

EVERY = np.vstack([REGISTRATION_M, CONTROL_M])


@pytest.mark.slow
def test_the_chain_finds_spheres_and_places_their_outlines() -> None:
    made = scene(1, width=1200, seed=2)
    image = render(made.camera, made.centres_camera(0, EVERY))
    exact, _ = exact_outlines(made, 0, EVERY, margin_px=60)
    found = DETECTORS["paper"](image, made.camera)
    hits = 0
    for true in exact:
        off_px = [np.arccos(np.clip(true.cone.axis @ o.cone.axis, -1, 1)) * made.camera.fx for o in found]
        if min(off_px, default=np.inf) < 3.0:  # Canny's points lie on whole pixels
            nearest = found[int(np.argmin(off_px))]
            hits += 1
            assert abs(nearest.cone.half_angle_rad - true.cone.half_angle_rad) * made.camera.fx < 3.0
            assert len(nearest.points) == 200
    assert hits >= 0.7 * len(exact)


def test_boxes_of_another_detector_are_used_as_they_are() -> None:
    made = scene(1, width=1200, seed=2)
    image = render(made.camera, made.centres_camera(0, EVERY))
    boxes = find_boxes(image)
    alone = detect_by_masks(image, made.camera, boxes=boxes[:1])
    assert len(alone) == 1
    x, y = alone[0].centre_px
    left, top, right, bottom = boxes[0]
    assert left < x < right
    assert top < y < bottom
    assert detect_by_masks(image, made.camera, boxes=[]) == ()


def test_an_ellipse_is_fitted_to_a_mask_by_its_false_pixels() -> None:
    rows, columns = np.mgrid[0:96, 0:96]
    mask = np.hypot((columns - 50) / 34, (rows - 46) / 29) < 1
    mask[40:52, 70:90] = False  # a wire's shadow
    estimate = fit_ellipse(mask, (0.0, 0.0, 96.0, 96.0))
    assert (estimate.x, estimate.y) == (pytest.approx(50, abs=1), pytest.approx(46, abs=1))
    assert sorted((estimate.a, estimate.b)) == [pytest.approx(29, abs=1.5), pytest.approx(34, abs=1.5)]


def test_where_nothing_differs_there_is_no_mask() -> None:
    grey = np.full((200, 300, 3), 120, dtype=np.uint8)
    assert sphere_mask(grey, (50.0, 50.0, 120.0, 120.0)) is None


def test_boxes_in_a_file_are_of_one_image_each(tmp_path: Path) -> None:
    made = scene(1, width=1200, seed=2)
    image = render(made.camera, made.centres_camera(0, EVERY))
    box = find_boxes(image)[0]
    cv2.imwrite(str(tmp_path / "a.png"), image)
    (tmp_path / "boxes.json").write_text(json.dumps({"a.png": [box]}))
    boxes = read_boxes(tmp_path / "boxes.json", ["a.png", "b.png"])
    assert len(detect_file_by_masks(tmp_path / "a.png", made.camera, boxes=boxes)) == 1
    assert detect_file_by_masks(tmp_path / "a.png", made.camera, boxes={}) == ()
    with pytest.raises(DataError, match=r"a\.png"):
        read_boxes(tmp_path / "boxes.json", ["b.png"])
