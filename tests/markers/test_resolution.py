"""Photographs at a lower resolution: image positions agree with the matching camera model."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from service.compute.camera_model import CameraModel
from service.compute.images.resample import camera_at, resample
from service.core.errors import ConfigurationError

CAMERA = CameraModel(1500, 1000, 2100.0, 2101.0, 755.0, 494.0, -0.05, 0.02, 2e-4, -1e-4)


@pytest.mark.parametrize(("width", "height"), [(750, 500), (600, 337), (400, 300), (1500, 1000)])
def test_a_point_stays_where_its_camera_says(width: int, height: int) -> None:
    points = np.array([[0.05, 0.02, 0.7], [-0.1, 0.03, 0.6], [0.0, -0.05, 0.65]])
    image = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    for u, v in CAMERA.project(points):
        cv2.circle(image, (round(u * 256), round(v * 256)), 9 * 256, (255, 255, 255), -1, cv2.LINE_AA, 8)
    small = resample(image, CAMERA, width, height)
    camera = camera_at(CAMERA, width, height)
    assert small.shape == (height, width, 3)
    assert (camera.width, camera.height) == (width, height)
    for u, v in camera.project(points):
        window = small[:, :, 0].astype(float)
        rows, columns = np.mgrid[0:height, 0:width]
        near = (np.hypot(columns - u, rows - v) < 12) * window
        seen = np.array([(near * columns).sum(), (near * rows).sum()]) / near.sum()
        np.testing.assert_allclose(seen, [u, v], atol=0.12)


def test_pixels_stay_square() -> None:
    camera = camera_at(CAMERA, 960, 540)
    assert camera.fx / camera.fy == pytest.approx(CAMERA.fx / CAMERA.fy, rel=1e-3)


def test_an_enlargement_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="not a reduction"):
        camera_at(CAMERA, 1600, 900)
