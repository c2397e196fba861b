"""Declared arms: the same checks for each; the reach of seven axes, and an elbow that keeps clear of obstacles."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from service.compute.arm_kinematics import chain, dh_jacobian, forward, postures, postures_near
from service.compute.planning.collision import PATH_STEP_RAD, Capsule, link_segments, nearest_contacts
from service.compute.planning.motion_plan import (
    PlanningScene,
    able_postures,
    best_posture,
    plan_motion,
)
from service.core.arms import ArmModel, arm_model, flange_pose, known_arms
from service.core.errors import ConfigurationError
from service.core.geometry import Array, inverse, to_rotation_vector, transform
from service.core.protocol import Motion, load_protocol
from service.core.seven_axes import elbow_angle_rad
from service.rig import CollisionSection, load_rig
from service.station import layout_of
from service.steps import params_models
from service.steps.context import StationLayout
from service.steps.kinds import viewpoint_capture
from service.steps.motion import ArmAtStation, usual_posture
from service.steps.plan_preview import preview_plans
from service.steps.viewpoints import ViewpointSet, plan_viewpoints
from simulators.scene.world import Scene

PROTOCOL = Path(__file__).parents[2] / "protocols" / "exvivo_spine.yaml"
MOUNT = transform(np.eye(3), np.array([0.0, -0.055, 0.095]))
LBR = arm_model("LBR Med 14")
LAYOUT = StationLayout("station_1", "robot", (0.70, 0.0, 0.055), (-1.0, 0.0, 0.0))
EVERY = pytest.mark.parametrize("arm", known_arms(), ids=lambda arm: arm.name)


@pytest.fixture(scope="module")
def planning_scene() -> PlanningScene:
    start = usual_posture(LBR, LAYOUT, MOUNT)
    return ArmAtStation(LAYOUT, LBR, MOUNT, CollisionSection(), None, Motion()).scene(start)


def drawn(arm: ArmModel, seed: int) -> Array:
    """Joints (N,) within the limits and within half a turn."""
    most = np.minimum(arm.limits_rad, 3.1)
    return np.random.default_rng(seed).uniform(-most, most)


# --- every arm ------------------------------------------------------------------------------------------------------


@EVERY
def test_what_is_declared_of_an_arm_fits_together(arm: ArmModel) -> None:
    for row in (arm.a_m, arm.d_m, arm.alpha_rad, arm.limits_rad, arm.speeds_rad_s, arm.usual_rad):
        assert row.shape == (arm.axes,)
    assert np.all(np.abs(arm.usual_rad) <= arm.limits_rad)
    assert np.all(arm.speeds_rad_s > 0.5)
    names = [link.name for link in arm.links]
    assert len(set(names)) == len(names)
    assert all(0 <= link.frame <= arm.axes and link.radius_m > 0 for link in arm.links)
    standing = {*names, "camera", "table", "specimen", "spheres", "surroundings"}
    assert {name for pair in arm.allowed for name in pair} <= standing


@EVERY
def test_the_links_follow_one_another_from_the_base_to_the_flange(arm: ArmModel) -> None:
    """No gap between neighbouring capsules, wherever the joints are: nothing of the arm is left out."""
    planning_scene = ArmAtStation(LAYOUT, arm, MOUNT, CollisionSection(), None, Motion()).scene(arm.usual_rad)
    joints = np.stack([drawn(arm, seed) for seed in range(8)])
    starts, ends, radii = link_segments(planning_scene.body, joints)
    flange = forward(arm, joints)[:, :3, 3]
    for k in range(len(arm.links) - 1):
        gap = np.linalg.norm(starts[:, k + 1] - ends[:, k], axis=1)
        assert np.all(gap <= radii[k] + radii[k + 1] + 0.005), arm.links[k + 1].name
    last = len(arm.links) - 1
    np.testing.assert_allclose(ends[:, last], flange, atol=1e-9)


@EVERY
@given(seed=st.integers(0, 10_000))
@settings(max_examples=12, deadline=None)
def test_every_posture_reaches_the_pose_within_the_limits(arm: ArmModel, seed: int) -> None:
    q = drawn(arm, seed)
    T = forward(arm, q[None])[0]
    for found in (postures(arm, T), postures_near(arm, T, q)):
        assert np.all(np.abs(found) <= arm.limits_rad + 1e-9)
        if len(found):
            np.testing.assert_allclose(forward(arm, found), np.broadcast_to(T, (len(found), 4, 4)), atol=1e-6)


@EVERY
def test_the_jacobian_of_the_geometry_is_the_derivative_of_the_pose(arm: ArmModel) -> None:
    values = arm.joint_values(drawn(arm, 3)[None])
    J = dh_jacobian(chain(values))[0]
    T, step = chain(values)[0, -1], 1e-6
    for k in range(4 * arm.axes):
        moved = values.copy()
        moved[0, k // 4, k % 4] += step
        np.testing.assert_allclose(to_rotation_vector(inverse(T) @ chain(moved)[0, -1]) / step, J[:, k], atol=2e-5)


# --- seven axes -----------------------------------------------------------------------------------------------------


def test_seven_axes_take_every_viewpoint_of_the_papers_protocol_and_the_ways_between_are_free(
    planning_scene: PlanningScene,
) -> None:
    protocol = load_protocol(PROTOCOL, params_models()).protocol
    params = protocol.step("viewpoint_capture_1").params_as(viewpoint_capture.Params)
    views = [(v.name, v.T_base_camera) for one in params.viewpoints for v in plan_viewpoints(one, LAYOUT)]
    plan = plan_motion(views, planning_scene, params.order)
    assert [view.outcome for view in plan.views] == ["feasible"] * 54
    here = planning_scene.start_rad
    for view in plan.views:
        assert np.all(np.abs(view.joints_rad) <= LBR.limits_rad)
        count = int(np.ceil(np.abs(view.joints_rad - here).max() / PATH_STEP_RAD))
        way = here + np.linspace(0, 1, count + 1)[1:, None] * (view.joints_rad - here)
        clearance_m = [
            contact.clearance_m for contact in nearest_contacts(planning_scene.body, planning_scene.obstacles, way)
        ]
        assert min(clearance_m) >= planning_scene.margin_m, view.name
        here = view.joints_rad


def test_the_elbow_gives_way_to_another_arm(planning_scene: PlanningScene) -> None:
    T = plan_viewpoints(_one(), LAYOUT)[2].T_base_camera
    usual = best_posture(T, planning_scene)
    assert usual is not None
    _, ends, _ = link_segments(planning_scene.body, usual[None])
    elbow = ends[0, planning_scene.body.parts.index("upper arm")]
    post = Capsule(elbow, elbow + np.array([0.0, 0.0, 0.3]), 0.05)
    beside = replace(planning_scene, obstacles=replace(planning_scene.obstacles, others=(("other arm", post),)))
    blocked = nearest_contacts(beside.body, beside.obstacles, usual[None])[0]
    assert str(blocked) == "the upper arm would touch the other arm"
    other = best_posture(T, beside)
    assert other is not None
    np.testing.assert_allclose(forward(LBR, other[None]), forward(LBR, usual[None]), atol=1e-6)
    assert abs(elbow_angle_rad(LBR, other) - elbow_angle_rad(LBR, usual)) > 0.1
    assert nearest_contacts(beside.body, beside.obstacles, other[None])[0].clearance_m >= beside.margin_m


def test_the_elbow_keeps_clear_of_the_table_and_of_the_limits_where_it_can(planning_scene: PlanningScene) -> None:
    for view in plan_viewpoints(_one(), LAYOUT):
        every = list(able_postures(view.T_base_camera, planning_scene))
        assert len(every) > 3
        room = np.degrees((LBR.limits_rad - np.abs(np.array(every))).min(axis=1))
        # The first is not at the edge of what is possible.
        assert room[0] >= min(5.0, float(np.median(room)))


@pytest.mark.slow
def test_an_obstacle_in_the_rig_file_is_named_in_the_plan(tmp_path: Path) -> None:
    obstacle = {"from_m": [0.70, 0.0, 0.3], "to_m": [0.70, 0.0, 1.5], "radius_m": 0.3}
    station = {"robot": "robot", "scene_centre_m": [0.70, 0.0, 0.055], "approach_azimuth_deg": 180.0}
    record = {
        "name": "OR 3",
        "devices": {"robot": {"driver": "kuka_sunrise", "host": "192.0.2.1"}},
        "stations": {"station_1": station, "station_2": {**station, "obstacles": {"lamp": obstacle}}},
        "T_flange_camera_nominal": MOUNT.tolist(),
        "collision": {"arm": "LBR Med 14"},
    }
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(record))
    rig, protocol = load_rig(tmp_path / "rig.yaml"), load_protocol(PROTOCOL, params_models()).protocol
    texts = [
        preview_plans(protocol, protocol.step(f"control_capture_{n}"), rig, partial(layout_of, rig))[0].text
        for n in (1, 2)
    ]
    assert texts[0].startswith("8 of 8 viewpoints")
    assert texts[1].startswith("0 of 8 viewpoints")
    assert "would touch the lamp" in texts[1]


def test_a_load_that_the_arm_does_not_carry_is_refused(tmp_path: Path) -> None:
    station = {"robot": "robot", "scene_centre_m": [0.70, 0.0, 0.055], "approach_azimuth_deg": 180.0}
    record = {
        "name": "OR 3",
        "devices": {"robot": {"driver": "kuka_sunrise", "host": "192.0.2.1"}},
        "stations": {"station_1": station},
        "T_flange_camera_nominal": MOUNT.tolist(),
        "payload": {"mass_kg": 15.0, "centre_of_gravity_m": [0.0, 0.0, 0.1]},
        "collision": {"arm": "LBR Med 14"},
    }
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(record))
    rig, protocol = load_rig(tmp_path / "rig.yaml"), load_protocol(PROTOCOL, params_models()).protocol
    with pytest.raises(ConfigurationError, match="of 15 kg is more than a LBR Med 14 carries, 14 kg"):
        preview_plans(protocol, protocol.step("control_capture_1"), rig, partial(layout_of, rig))


# --- the simulated arms ---------------------------------------------------------------------------------------------


def test_a_scene_is_the_same_for_every_arm_and_an_lbr_errs_by_most_of_a_millimetre() -> None:
    usual, scene = Scene.generate(7), Scene.generate(7, arm="LBR Med 14")
    np.testing.assert_array_equal(scene.registration_m, usual.registration_m)
    assert scene.lens == usual.lens
    errors: list[float] = []
    for k in range(40):
        q = LBR.usual_rad + np.random.default_rng(k).uniform(-0.4, 0.4, 7)
        reported = scene.nominal_flange(q)
        np.testing.assert_allclose(reported, forward(LBR, q[None])[0], atol=1e-12)
        true = inverse(scene.T_world_base["station_1"]) @ scene.true_flange(q, "station_1")
        np.testing.assert_array_equal(scene.true_flange(q, "station_1"), scene.true_flange(q, "station_1"))
        errors.append(1e3 * float(np.linalg.norm(true[:3, 3] - reported[:3, 3])))
    assert 0.4 < float(np.sqrt(np.mean(np.square(errors)))) < 1.2


def _one() -> ViewpointSet:
    protocol = load_protocol(PROTOCOL, params_models()).protocol
    return protocol.step("control_capture_1").params_as(viewpoint_capture.Params).viewpoints[0]


@EVERY
def test_one_posture_and_many_are_computed_alike(arm: ArmModel) -> None:
    q = np.random.default_rng(5).uniform(-2.5, 2.5, (4, arm.axes))
    for joints, T_base_flange in zip(q, forward(arm, q), strict=True):
        np.testing.assert_allclose(flange_pose(arm, joints), T_base_flange, atol=1e-12)
