"""The planner: distances, postures, feasibility, order, depth of field."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace
from functools import partial
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from typer.testing import CliRunner

from service.cli.main import app
from service.compute.arm_kinematics import forward, nearest_posture, postures
from service.compute.planning.collision import (
    Capsule,
    nearest_contacts,
    segment_box_distance_m,
    segment_distance_m,
    straight_path,
)
from service.compute.planning.motion_plan import (
    MotionPlan,
    PlanningScene,
    best_posture,
    best_postures,
    depth_of_field,
    infeasible_reason,
    plan_motion,
    shortest_order,
    travel_times_s,
)
from service.core.arms import arm_model
from service.core.geometry import Array, Transform, inverse, look_at, transform
from service.core.protocol import Motion, load_protocol
from service.rig import CollisionSection, load_rig
from service.station import layout_of
from service.steps import params_models
from service.steps.context import StationLayout
from service.steps.kinds import viewpoint_capture
from service.steps.motion import ArmAtStation, usual_posture
from service.steps.plan_preview import preview_board_poses, preview_plans
from service.steps.viewpoints import Arc, ViewpointSet, denser_viewpoints, plan_viewpoints

PROTOCOL = Path(__file__).parents[2] / "protocols" / "exvivo_spine.yaml"
ARM = arm_model("UR10e")
T_FLANGE_CAMERA = transform(np.eye(3), np.array([0.0, -0.055, 0.095]))
LAYOUT = StationLayout("station_1", "robot", (-0.074, 0.794, 0.137), (0.0924, -0.9957, 0.0))
vectors = arrays(np.float64, 3, elements=st.floats(-1, 1, width=32))


@pytest.fixture(scope="module")
def scene() -> PlanningScene:
    start = usual_posture(ARM, LAYOUT, T_FLANGE_CAMERA)
    return ArmAtStation(LAYOUT, ARM, T_FLANGE_CAMERA, CollisionSection(), None, Motion()).scene(start)


def camera_at(eye: tuple[float, float, float]) -> Transform:
    """A camera at a position relative to the scene's centre, looking at it."""
    centre = np.array(LAYOUT.scene_centre_m)
    return look_at(centre + np.array(eye), centre, -np.array(LAYOUT.approach))


def planned(scene: PlanningScene, *poses: Transform) -> MotionPlan:
    return plan_motion([(f"v{i}", T) for i, T in enumerate(poses)], scene, "as_listed")


# --- distances ------------------------------------------------------------------------------------------------


@given(vectors, vectors, vectors, vectors)
@settings(max_examples=60, deadline=None)
def test_distance_of_segments_is_the_least_of_all_their_points(p0: Array, p1: Array, q0: Array, q1: Array) -> None:
    t = np.linspace(0, 1, 201)[:, None]
    p, q = p0 + t * (p1 - p0), q0 + t * (q1 - q0)
    sampled = float(np.linalg.norm(p[:, None] - q[None], axis=2).min())
    distance = float(segment_distance_m(p0, p1, q0, q1))
    coarse = 0.005 * float(np.linalg.norm(p1 - p0) + np.linalg.norm(q1 - q0)) / 2
    assert distance <= sampled + 1e-9
    assert distance >= sampled - coarse - 1e-9
    assert distance == pytest.approx(float(segment_distance_m(q0, q1, p1, p0)), abs=1e-9)


@given(vectors, vectors)
@settings(max_examples=60, deadline=None)
def test_distance_of_a_segment_to_a_box_is_the_least_of_all_its_points(p0: Array, p1: Array) -> None:
    half = np.array([0.3, 0.2, 0.1])
    points = p0 + np.linspace(0, 1, 401)[:, None] * (p1 - p0)
    sampled = float(np.linalg.norm(np.maximum(np.abs(points) - half, 0), axis=1).min())
    distance = float(segment_box_distance_m(p0, p1, half))
    assert distance <= sampled + 1e-6
    assert distance >= sampled - 0.00125 * float(np.linalg.norm(p1 - p0)) - 1e-6


# --- postures ----------------------------------------------------------------------------------------------------


@given(arrays(np.float64, 6, elements=st.floats(-3.1, 3.1)), st.sampled_from(["UR10e", "UR5e", "UR3e"]))
@settings(max_examples=60, deadline=None)
def test_every_posture_reaches_the_pose_and_the_given_one_is_among_them(q: Array, name: str) -> None:
    arm = arm_model(name)
    T = forward(arm, q[None])[0]
    found = postures(arm, T)
    if (
        abs(np.sin(q[4])) < 1e-3
        or abs(np.sin(q[2])) < 1e-3
        or abs(np.hypot(*(T[:2, 3] - arm.d_m[5] * T[:2, 2]))) < 0.2
    ):
        return  # near a singularity a posture is a whole family, or two that have merged
    assert np.allclose(forward(arm, found), T, atol=1e-6)
    apart = np.abs(np.angle(np.exp(1j * (found - q)))).max(axis=1)
    assert apart.min() < 1e-5


# The demonstration's two board images that replaced others, at its first station: the second turned the wrist over.
BEFORE_RAD = np.array([4.97, -1.56, 1.04, -1.21, -1.96, -6.17])  # the camera cannot turn on: its limit is near
TURNED_OVER_RAD = np.array([2.62, -2.57, 1.52, -3.51, 1.13, -5.59])


def test_shoulder_elbow_and_wrist_keep_their_sides_though_the_camera_must_turn_far() -> None:
    """Before, the arm went on with its wrist turned over, and at station 2 every way was blocked."""
    T = forward(ARM, TURNED_OVER_RAD[None])[0]
    found = nearest_posture(ARM, T, BEFORE_RAD)
    assert found is not None
    np.testing.assert_allclose(forward(ARM, found[None])[0], T, atol=1e-9)
    assert np.sign(np.sin(found[4])) == np.sign(np.sin(BEFORE_RAD[4]))
    assert np.sign(found[2]) == np.sign(BEFORE_RAD[2])
    assert found[5] - BEFORE_RAD[5] > 3.0


def test_the_nearest_posture_turns_no_joint_by_a_needless_revolution() -> None:
    q = np.array([4.5, -1.7, 1.4, -1.4, -1.5, -6.0])
    T = forward(ARM, q[None])[0]
    found = nearest_posture(ARM, T, q + 0.1)
    assert found is not None
    assert np.allclose(found, q, atol=1e-6)


# --- feasibility ---------------------------------------------------------------------------------------------------


def test_every_viewpoint_of_the_papers_protocol_is_within_reach_and_touches_nothing(scene: PlanningScene) -> None:
    protocol = load_protocol(PROTOCOL, params_models()).protocol
    count = 0
    for step in protocol.steps:
        if not isinstance(step.params, viewpoint_capture.Params):
            continue
        for one in step.params.viewpoints:
            for view in plan_viewpoints(one, LAYOUT):
                target = view.T_base_camera @ inverse(T_FLANGE_CAMERA)
                joints = nearest_posture(ARM, target, scene.start_rad)
                assert infeasible_reason(view.T_base_camera, joints, scene) == "", view.name
                count += 1
    assert count == 124


def test_the_way_between_the_papers_viewpoints_is_free_and_shorter_than_as_listed(scene: PlanningScene) -> None:
    protocol = load_protocol(PROTOCOL, params_models()).protocol
    params = protocol.step("viewpoint_capture_1").params_as(viewpoint_capture.Params)
    views = [(v.name, v.T_base_camera) for one in params.viewpoints for v in plan_viewpoints(one, LAYOUT)]
    plan = plan_motion(views, scene, params.order)
    assert {view.name for view in plan.feasible} == {name for name, _ in views}
    assert plan.total_s < plan.listed_s
    few, again = (plan_motion(views[::6], scene, params.order) for _ in range(2))
    assert [v.name for v in again.views] == [v.name for v in few.views]


# Where the arm of scene 11 stood after its last board image, turned far from the postures of the viewpoints.
FAR_TURNED_RAD = np.array([-5.31, -2.94, 1.24, 2.99, 2.25, -0.82])


def test_an_arm_that_stands_far_turned_goes_by_a_detour_and_touches_nothing(scene: PlanningScene) -> None:
    turned = replace(scene, start_rad=FAR_TURNED_RAD)
    poses = [camera_at((x, -0.2, 0.6)) for x in (-0.3, -0.1, 0.1, 0.3)]
    plan = planned(turned, *poses)
    assert [view.outcome for view in plan.views] == ["feasible"] * 4
    first, *later = plan.views
    assert len(first.way_rad) >= 2
    assert not any(len(view.way_rad) for view in later), "from there the ways are straight"
    assert np.array_equal(first.way_rad[0], FAR_TURNED_RAD)
    way = [*first.way_rad, *(view.joints_rad for view in plan.views)]
    fine = [straight_path(a, b, float(np.radians(0.5)))[1:] for a, b in pairwise(way)]
    ends = len(fine[0])
    contacts = nearest_contacts(turned.body, turned.obstacles, np.concatenate(fine))
    near = [contact.clearance_m for contact in contacts]
    assert min(near[ends:]) > turned.margin_m - 0.002, "between configurations that were checked it comes no nearer"
    assert min(near[:ends]) > 0.0, "it stood within the margin"
    assert first.travel_s > sum(view.travel_s for view in later) / 3
    assert planned(turned, *poses).views[0].way_rad.tolist() == first.way_rad.tolist(), "the same each time"


def test_a_viewpoint_through_the_table_is_refused_and_says_so(scene: PlanningScene) -> None:
    plan = planned(scene, camera_at((0.35, -0.3, -0.02)), camera_at((0.0, 0.0, 0.62)))
    assert [v.outcome for v in plan.views] == ["feasible", "refused"]
    assert "table" in plan.refused[0].reason or "specimen" in plan.refused[0].reason


@pytest.mark.slow
def test_an_arm_that_stands_in_an_obstacle_is_told_so_instead_of_a_blocked_way(scene: PlanningScene) -> None:
    at_flange = forward(ARM, scene.start_rad[None])[0][:3, 3]
    stand = Capsule(at_flange, at_flange + np.array([0.0, 0.0, 0.05]), 0.05)
    inside = replace(scene, obstacles=replace(scene.obstacles, others=(("lamp", stand),)))
    (view,) = planned(inside, camera_at((0.2, -0.2, 0.6))).views
    assert view.outcome == "refused"
    assert view.reason.startswith("where the arm stands, the ")
    assert view.reason.endswith("would touch the lamp: move it clear by its pendant")


def test_a_viewpoint_in_the_specimen_is_refused_and_says_so(scene: PlanningScene) -> None:
    reason = planned(scene, camera_at((0.0, 0.01, 0.14))).refused[0].reason
    assert "camera would touch the specimen" in reason


def test_a_viewpoint_out_of_reach_is_refused_and_says_so(scene: PlanningScene) -> None:
    assert planned(scene, camera_at((0.0, 1.2, 0.9))).refused[0].reason == "the arm does not reach it"


def test_a_viewpoint_blocked_by_a_sphere_is_carried_along_its_arc(scene: PlanningScene) -> None:
    T = camera_at((0.25, -0.3, 0.5))
    at_lens = T[:3, 3] + 0.1 * T[:3, 2]
    post = Capsule(at_lens, at_lens - np.array([0.0, 0.0, 0.05]), 0.01)
    blocked = replace(scene, obstacles=replace(scene.obstacles, spheres=(post,)))
    assert planned(scene, T).views[0].outcome == "feasible"
    (view,) = planned(blocked, T).views
    assert view.outcome == "nudged"
    assert "spheres" in view.reason
    centre = np.array(LAYOUT.scene_centre_m)
    assert np.isclose(np.linalg.norm(view.T_base_camera[:3, 3] - centre), np.linalg.norm(T[:3, 3] - centre))
    assert nearest_contacts(blocked.body, blocked.obstacles, view.joints_rad[None])[0].clearance_m >= 0.01


def test_a_viewpoint_with_the_scene_out_of_focus_is_refused_and_says_so(scene: PlanningScene) -> None:
    sharp = replace(scene, sharp=depth_of_field(0.05, 22, 0.6, 45e-6))
    assert planned(scene, camera_at((0.0, -0.1, 0.82))).views[0].outcome == "feasible"
    assert planned(sharp, camera_at((0.0, 0.0, 0.62))).views[0].outcome == "feasible"
    assert "the sharp range is" in planned(sharp, camera_at((0.0, -0.1, 0.82))).refused[0].reason


def test_depth_of_field_is_bounded_by_equal_circles_of_confusion() -> None:
    f, aperture, s, c = 0.05, 22.0, 0.65, 45e-6
    sharp = depth_of_field(f, aperture, s, c)
    for distance in (sharp.near_m, sharp.far_m):
        image, plane = 1 / (1 / f - 1 / distance), 1 / (1 / f - 1 / s)
        assert f / aperture * abs(image - plane) / image == pytest.approx(c, rel=1e-9)
    assert depth_of_field(f, aperture, 10.0, c).far_m == float("inf")


# --- order -----------------------------------------------------------------------------------------------------


@given(arrays(np.float64, st.tuples(st.integers(4, 12), st.just(6)), elements=st.floats(-2, 2, width=16)))
@settings(max_examples=40, deadline=None)
def test_the_shortest_order_is_a_permutation_and_never_longer_than_the_list(joints: Array) -> None:
    start = usual_posture(ARM, LAYOUT, T_FLANGE_CAMERA)
    times = travel_times_s(
        joints, ArmAtStation(LAYOUT, ARM, T_FLANGE_CAMERA, CollisionSection(), None, Motion()).scene(start)
    )
    order = shortest_order(times)

    def length(path: list[int]) -> float:
        nodes = [0, *(i + 1 for i in path)]
        return sum(float(times[a, b]) for a, b in pairwise(nodes))

    assert sorted(order) == list(range(len(joints) - 1))
    assert length(order) <= length(list(range(len(joints) - 1))) + 1e-9


def test_extra_viewpoints_keep_their_names_and_their_distance_from_planned_ones() -> None:
    protocol = load_protocol(PROTOCOL, params_models()).protocol
    one = protocol.step("viewpoint_capture_1").params_as(viewpoint_capture.Params).viewpoints[0]
    extra = denser_viewpoints(one, LAYOUT)
    assert len({v.name for v in extra}) == len(extra) > 10
    assert [v.name for v in denser_viewpoints(one, LAYOUT)] == [v.name for v in extra]
    planned_eyes = np.array([v.T_base_camera[:3, 3] for v in plan_viewpoints(one, LAYOUT)])
    for view in extra:
        assert np.linalg.norm(planned_eyes - view.T_base_camera[:3, 3], axis=1).min() > 0.03


def test_beside_a_turntable_the_top_of_every_image_points_upwards() -> None:
    arc = Arc(tilt_deg=40, azimuth_from_deg=-170, azimuth_to_deg=170, count=9, distance_m=0.5)
    views = plan_viewpoints(ViewpointSet(station="s", prefix="t", arcs=(arc,), image_top="up"), LAYOUT)
    poses = np.array([view.T_base_camera for view in views])
    np.testing.assert_allclose(poses[:, 2, 0], 0.0, atol=1e-12)  # the image's rows are level
    np.testing.assert_allclose(poses[:, 2, 1], -np.sin(np.radians(40)), atol=1e-4)
    turned = poses[1:] @ np.linalg.inv(poses[:-1])
    np.testing.assert_allclose(turned[:, :3, 2], np.tile([0.0, 0.0, 1.0], (8, 1)), atol=1e-4)  # about the vertical


def test_an_image_from_straight_above_has_no_top_that_points_upwards() -> None:
    arc = Arc(tilt_deg=0, azimuth_from_deg=0, azimuth_to_deg=0, count=1, distance_m=0.5)
    with pytest.raises(ValueError, match="straight down"):
        ViewpointSet(station="s", prefix="t", arcs=(arc,), image_top="up")


# --- command -----------------------------------------------------------------------------------------------------

RIG = """\
name: OR 3
devices: {robot: {driver: ur, host: 192.0.2.1}}
stations:
  station_1: {robot: robot, scene_centre_m: [0.0, 0.75, 0.13], approach_azimuth_deg: -90}
  station_2: {robot: robot, scene_centre_m: [0.0, 0.75, 0.13], approach_azimuth_deg: -90}
T_flange_camera_nominal: [[1, 0, 0, 0], [0, 1, 0, -0.055], [0, 0, 1, 0.095], [0, 0, 0, 1]]
"""


def test_the_command_plans_from_files_alone(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(RIG + "collision: {arm: UR10e}\n")
    words = ("plan", "show", str(PROTOCOL), "--rig", str(tmp_path / "rig.yaml"), "--step", "control_capture_1")
    done = CliRunner().invoke(app, [*words, "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    (plan,) = json.loads(done.stdout)["control_capture_1"]
    assert [view["outcome"] for view in plan["views"]] == ["feasible"] * 8
    assert plan["estimated_s"] > 0
    (tmp_path / "rig.yaml").write_text(RIG)
    assert "nothing to plan" in CliRunner().invoke(app, list(words)).stderr


def test_a_person_sees_the_plan_before_confirming(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(RIG + "collision: {arm: UR10e}\n")
    rig, protocol = load_rig(tmp_path / "rig.yaml"), load_protocol(PROTOCOL, params_models()).protocol
    (plan,) = preview_plans(protocol, protocol.step("control_capture_2"), rig, partial(layout_of, rig))
    assert plan.text.startswith("8 of 8 viewpoints, about ")
    assert preview_plans(protocol, protocol.step("fixation"), rig, partial(layout_of, rig)) == ()


@pytest.mark.slow
@pytest.mark.parametrize("step", ["intrinsics", pytest.param("hand_eye", marks=pytest.mark.sweep)])
def test_the_papers_board_images_are_planned_from_files_alone(tmp_path: Path, step: str) -> None:
    lens = "lens: {focal_length_mm: 50, sensor_width_mm: 35.7, image_px: [1920, 1280]}\n"
    (tmp_path / "rig.yaml").write_text(RIG + "collision: {arm: UR10e}\n" + lens)
    words = ("plan", "show", str(PROTOCOL), "--rig", str(tmp_path / "rig.yaml"), "--step", step)
    done = CliRunner().invoke(app, [*words, "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    (plan,) = json.loads(done.stdout)[step]
    count = {"intrinsics": 90, "hand_eye": 30}[step]
    assert len(plan["poses"]) == count
    assert plan["text"].startswith(f"{count} of {count} board poses; predicted coverage ")
    predicted = plan["prediction"]
    assert len(predicted["coverage_map"]) == 8
    if step == "intrinsics":
        assert predicted["coverage"] >= 0.95
        assert predicted["uncertainty_mm"] < 0.05
        assert predicted["tilt_deg"] > 33
    else:
        assert predicted["hand_eye_sigma_mm"] < 0.5
        assert predicted["rotation_spread_deg"] > 90
    printed = CliRunner().invoke(app, [*words])
    assert f"{count} of {count} board poses" in printed.output


def test_a_step_without_a_board_has_no_board_poses(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(RIG + "collision: {arm: UR10e}\n")
    rig, protocol = load_rig(tmp_path / "rig.yaml"), load_protocol(PROTOCOL, params_models()).protocol
    assert preview_board_poses(protocol, protocol.step("fixation"), rig, partial(layout_of, rig)) is None


def test_poses_that_are_checked_together_get_the_postures_of_each_alone(scene: PlanningScene) -> None:
    draw = np.random.default_rng(4)
    poses = [camera_at((x, y, z)) for x, y, z in draw.uniform([-0.5, -0.7, -0.05], [0.5, 0.6, 0.8], (40, 3))]
    alone = [best_posture(T, scene) for T in poses]
    assert 0 < sum(joints is None for joints in alone) < len(poses)
    for joints, together in zip(alone, best_postures(poses, scene), strict=True):
        if joints is None or together is None:
            assert joints is together
        else:
            assert np.array_equal(joints, together)
    assert best_postures([camera_at((0.0, 1.2, 0.9))], scene) == [None], "out of reach"


def two_opt_pair_by_pair(path: list[int], times: Array) -> list[int]:
    """The definition: each stretch in turn is reversed if that makes the path shorter, until none does."""

    def length(nodes: list[int]) -> float:
        return sum(float(times[a, b]) for a, b in pairwise([0, *nodes]))

    improved = True
    while improved:
        improved = False
        for i, j in combinations(range(len(path)), 2):
            reversed_there = [*path[:i], *path[i : j + 1][::-1], *path[j + 1 :]]
            if length(reversed_there) < length(path) - 1e-9:
                path, improved = reversed_there, True
    return path


@pytest.mark.parametrize("digits", [9, 1], ids=["no ties", "ties"])
def test_many_stretches_compared_at_once_give_the_order_of_one_by_one(digits: int) -> None:
    joints = np.round(np.random.default_rng(5).uniform(-2, 2, (25, 6)), digits)
    times = np.abs(joints[:, None] - joints[None]).max(axis=2)
    nearest, left = list[int](), set(range(1, len(times)))
    while left:
        here = nearest[-1] if nearest else 0
        nearest.append(min(left, key=lambda node: (times[here, node], node)))
        left.remove(nearest[-1])
    ways = [two_opt_pair_by_pair(path, times) for path in (list(range(1, len(times))), nearest)]
    best = min(ways, key=lambda path: sum(float(times[a, b]) for a, b in pairwise([0, *path])))
    calls: list[int] = []
    assert shortest_order(times, lambda: calls.append(1)) == [node - 1 for node in best]
    assert len(calls) >= len(best), "whoever waits for it is told that it goes on"


@pytest.mark.slow
def test_a_plan_in_the_listed_order_does_not_compare_every_viewpoint_with_every_other(
    scene: PlanningScene,
) -> None:
    poses = [camera_at((0.001 * number, -0.1, 0.62)) for number in range(400)]
    planned(scene, *poses[:2])  # loads once what must not be counted
    tracemalloc.start()
    try:
        plan = planned(scene, *poses)
        _, most_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(plan.feasible) == 400
    assert plan.listed_s == pytest.approx(plan.total_s)
    assert most_bytes < 8 * 400 * 400 * 3, "less than a few numbers for each pair"
