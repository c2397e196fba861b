"""One hand-held image: the camera's pose from its spheres with exact outlines, and what makes an image unusable."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from service.compute.hand_held import HandView, look_at_image
from service.compute.markers.records import DEFAULTS
from service.core.geometry import Array, inverse, look_at, rotation_angle_rad
from tests.support.runs.measuring_rig import SPHERES_M
from tests.support.scenes.sphere_images import Scene, camera, exact_outlines

RADIUS_M = 0.015
CAMERA = camera(1200)
T_SCENE_CAMERA = look_at(
    SPHERES_M.mean(axis=0) + np.array([0.25, -0.2, 0.75]), SPHERES_M.mean(axis=0), np.array([0.0, 1.0, 0.0])
)


def look(
    monkeypatch: pytest.MonkeyPatch,
    *,
    spheres_m: Array = SPHERES_M,
    shown: int | None = None,
    rough: bool = False,
    bright: int = 180,
) -> HandView:
    scene = Scene(np.eye(4), np.array([T_SCENE_CAMERA]), CAMERA)
    outlines = exact_outlines(scene, 0, SPHERES_M, 0.1, margin_px=30)[0][:shown]

    def detected(*_args: Any) -> Any:
        return outlines

    monkeypatch.setattr("service.compute.hand_held.detect_spheres", detected)
    image = np.full((CAMERA.height, CAMERA.width, 3), bright, dtype=np.uint8)
    return look_at_image(image, CAMERA, spheres_m, RADIUS_M, DEFAULTS, rough=rough)


def test_the_spheres_tell_where_the_camera_was(monkeypatch: pytest.MonkeyPatch) -> None:
    view = look(monkeypatch)
    assert view.T_scene_camera is not None
    assert view.information is not None
    apart = inverse(T_SCENE_CAMERA) @ view.T_scene_camera
    assert np.linalg.norm(apart[:3, 3]) < 0.002
    assert rotation_angle_rad(apart) < 0.002
    assert view.why == ""
    assert view.spheres_seen >= 4


def test_spheres_known_from_photographs_alone_tell_it_roughly(monkeypatch: pytest.MonkeyPatch) -> None:
    off = np.random.default_rng(5).normal(0.0, 0.0015, SPHERES_M.shape)
    view = look(monkeypatch, spheres_m=SPHERES_M + off, rough=True)
    assert view.T_scene_camera is not None
    apart = inverse(T_SCENE_CAMERA) @ view.T_scene_camera
    assert np.linalg.norm(apart[:3, 3]) < 0.03
    assert rotation_angle_rad(apart) < 0.03
    assert view.why == ""


def test_too_few_spheres_tell_nothing_and_the_image_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    view = look(monkeypatch, shown=3)
    assert view.T_scene_camera is None
    assert "3 spheres found" in view.why


def test_a_third_of_the_spheres_behind_a_finger_are_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    everything = look(monkeypatch)
    view = look(monkeypatch, shown=round(0.55 * everything.spheres_expected))
    assert "something is in front of the lens" in view.why or view.T_scene_camera is None
    assert view.why


@pytest.mark.parametrize(("bright", "word"), [(255, "overexposed"), (20, "underexposed")])
def test_exposure_is_judged(monkeypatch: pytest.MonkeyPatch, bright: int, word: str) -> None:
    assert word in look(monkeypatch, bright=bright).why
