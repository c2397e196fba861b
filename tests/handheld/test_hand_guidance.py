"""Guidance for a hand-held camera: a simulated hand that follows the words arrives."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.compute.hand_held import (
    Attitude,
    away_from_plane,
    covered,
    level_frame,
    nearest,
    place_at,
    same_view,
    words,
)
from service.core.geometry import Array, inverse, look_at
from simulators.hand.technician import MISHAPS, Grip, Hand, Kind, Press, follow

_ANGLE = st.floats(-np.pi, np.pi)
_LEVEL = st.floats(-1.1, 1.1)
_TILT = st.floats(0.1, 2.4)
_METRES = st.floats(-0.6, 0.6)
_GRIPS = st.builds(
    lambda x, y, z, turn, lean, tilt: Grip(np.array([x, y, z + 0.7]), turn, lean, tilt),
    _METRES, _METRES, _METRES, _ANGLE, _LEVEL, _TILT,
)  # fmt: skip


def _apart(a: Array, b: Array) -> tuple[float, float]:
    T = inverse(a) @ b
    return float(np.linalg.norm(T[:3, 3])), float(Rotation.from_matrix(T[:3, :3]).magnitude())


@given(_GRIPS, _GRIPS)
def test_who_follows_the_words_arrives(here: Grip, there: Grip) -> None:
    target = there.T_world_camera()
    grip = here
    for _ in range(3):
        grip = follow(words(grip.T_world_camera(), target), grip, np.zeros(3))
    away_m, turned_rad = _apart(grip.T_world_camera(), target)
    assert away_m < 0.01  # less than half a centimetre per direction is not reported
    assert turned_rad < np.radians(5.0)


@given(_GRIPS, _GRIPS)
def test_one_message_brings_the_camera_near(here: Grip, there: Grip) -> None:
    grip = follow(words(here.T_world_camera(), there.T_world_camera()), here, np.zeros(3))
    away_m, turned_rad = _apart(grip.T_world_camera(), there.T_world_camera())
    assert away_m < 0.045
    assert turned_rad < np.radians(5.0)


@given(_GRIPS)
def test_the_attitude_of_a_camera_is_its_own(grip: Grip) -> None:
    R = grip.T_world_camera()[:3, :3]
    np.testing.assert_allclose(Attitude.of(R).matrix(), R, atol=1e-9)


@given(_GRIPS)
def test_nothing_is_said_where_nothing_is_to_be_changed(grip: Grip) -> None:
    assert words(grip.T_world_camera(), grip.T_world_camera()) == ""


def test_words_as_a_person_says_them() -> None:
    here = Grip(np.array([0.0, 0.0, 0.7]))
    there = Grip(np.array([-0.2, 0.0, 0.6]), tilt_rad=np.radians(75), turn_rad=np.radians(-30))
    said = words(here.T_world_camera(), there.T_world_camera())
    assert said == "20 cm to the left, 10 cm lower, turn 30° to the right, tilt 15° up"


def test_left_is_left_of_the_person_whichever_way_he_stands() -> None:
    here = Grip(np.array([0.0, 0.5, 0.6]), turn_rad=np.pi)  # on the far side, looking back
    there = Grip(np.array([0.3, 0.5, 0.6]), turn_rad=np.pi)
    assert words(here.T_world_camera(), there.T_world_camera()) == "30 cm to the left"


@pytest.mark.parametrize("azimuth_deg", [-180.0, -90.0, 0.0, 45.0, 120.0])
@pytest.mark.parametrize("walk_round", [True, False])
def test_a_place_looks_at_its_aim(azimuth_deg: float, walk_round: bool) -> None:
    aim = (0.02, -0.01, 0.03)
    place = place_at("p", tilt_deg=35.0, azimuth_deg=azimuth_deg, distance_m=0.6, walk_round=walk_round, aim_m=aim)
    T = place.T_level_camera
    np.testing.assert_allclose(T[:3, 3] + 0.6 * T[:3, 2], aim, atol=1e-12)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert T[2, 3] - aim[2] == pytest.approx(0.6 * np.cos(np.radians(35.0)))
    if walk_round:
        assert T[2, 0] == pytest.approx(0.0)  # level: the person walks around instead of leaning the camera


def test_a_tour_of_the_hemisphere_covers_it_and_goes_to_the_nearest_place_first() -> None:
    places = [
        place_at(f"{k}", tilt_deg=30.0, azimuth_deg=40.0 * k, distance_m=0.65, walk_round=True, aim_m=(0, 0, 0))
        for k in range(9)
    ]
    poses = [places[0].T_level_camera]
    order = ["0"]
    while len(done := covered(places, poses, 14.0)) < len(places):
        target = nearest([place for place in places if place.name not in done], poses[-1])
        order.append(target.name)
        poses.append(target.T_level_camera)
    steps = [abs(int(a) - int(b)) for a, b in pairwise(order)]
    assert len(order) == 9
    assert all(step in (1, 8) for step in steps)


def test_an_image_from_the_same_side_that_looks_elsewhere_does_not_cover_a_place() -> None:
    place = place_at("p", tilt_deg=20.0, azimuth_deg=0.0, distance_m=0.65, walk_round=True, aim_m=(0, 0, 0))
    astray = look_at(place.T_level_camera[:3, 3], np.array([0.4, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    assert covered([place], [astray], 14.0) == set()
    assert covered([place], [place.T_level_camera], 14.0) == {"p"}


def test_the_level_frame_stands_on_the_scene_with_the_person_at_its_near_side() -> None:
    rng = np.random.default_rng(3)
    spheres = np.column_stack([rng.uniform(-0.2, 0.2, (10, 2)), rng.uniform(0.03, 0.06, 10)])
    T_scene_camera = Grip(np.array([0.0, 0.0, 0.7]), turn_rad=0.4).T_world_camera()
    up = away_from_plane(spheres, T_scene_camera[:3, 3])
    level = level_frame(spheres.mean(axis=0), up, -T_scene_camera[:3, 1])
    np.testing.assert_allclose(level[:3, :3] @ level[:3, :3].T, np.eye(3), atol=1e-12)
    assert level[2, 2] > 0.98
    assert level[:3, 1] @ -T_scene_camera[:3, 1] > 0.98


def test_a_view_next_to_another_is_the_same() -> None:
    here = Grip(np.array([0.0, 0.0, 0.7]))
    near, far = Grip(np.array([0.01, 0.0, 0.7])), Grip(np.array([0.05, 0.0, 0.7]))
    assert same_view(here.T_world_camera(), near.T_world_camera(), 0.02, 0.05)
    assert not same_view(here.T_world_camera(), far.T_world_camera(), 0.02, 0.05)


def test_a_clumsy_hand_makes_every_mistake_and_a_steady_one_none() -> None:
    cases: list[tuple[Kind, set[str]]] = [("clumsy", set(MISHAPS)), ("steady", set())]
    for kind, expected in cases:
        presses: list[Press] = []
        poses: list[Array] = []
        hand = Hand(kind, 7, poses.append, presses.append, np.zeros(3))
        for _ in range(10):
            hand.do("next: 20 cm to the left")
        assert set(hand.mishaps) == expected
        assert any(press.finger for press in presses) == ("finger" in expected)
        assert any(press.iso for press in presses) == ("settings" in expected)
        assert len(poses) == len(presses) == 10


def test_a_hand_leaves_unread_what_is_not_for_it() -> None:
    presses: list[Press] = []
    hand = Hand("steady", 7, lambda _: None, presses.append, np.zeros(3))
    hand.read("h_001: 9/10 spheres, 20 cm to the left")
    assert hand.presses == 0
