"""Search where poses predict spheres: the same outlines as from whole images, and no forced matches."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.compute.images.photographs import read_image, read_reduced
from service.compute.markers.cones import ObservedCones, cone_of_sphere, fit_pose
from service.compute.markers.detect import detect_spheres
from service.compute.markers.image_files import LocatedOutlines, detect_all, locate_outlines, spread_views
from service.compute.markers.predicted import NEAR, WIDE, PredictedSpheres, locate_predicted, tone_of, visible_cones
from service.compute.markers.records import SphereOutline
from service.compute.pipeline import PipelineResult, register_images
from service.compute.registration.accuracy import true_error_m
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import DataError
from service.core.geometry import Array, apply, inverse, look_at, transform
from tests.support.scenes.sphere_images import (
    CONTROL_M,
    RADIUS_M,
    REGISTRATION_M,
    Scene,
    camera,
    exact_outlines,
    render,
    scene,
)

N, WIDTH = 7, 720
OUTLINE_PX = 0.3  # outline error in these small images, size errors and common shifts included
SCENE_M = 0.65  # from the cameras
EVERYTHING = np.vstack([REGISTRATION_M, CONTROL_M])
Captured = tuple[Scene, list[Path], tuple[tuple[SphereOutline, ...], ...]]


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Captured:
    """Images, and what a search of the whole images finds."""
    folder = tmp_path_factory.mktemp("images")
    made = scene(N, WIDTH, seed=21)
    paths: list[Path] = []
    for i in range(N):
        paths.append(folder / f"view_{i}.jpg")
        picture = render(made.camera, made.centres_camera(i, EVERYTHING), i, oversample=2)
        assert cv2.imwrite(str(paths[-1]), picture, [cv2.IMWRITE_JPEG_QUALITY, 95])
    return made, paths, detect_all(paths, made.camera)


def erring(poses: Array, place_m: float, turn_rad: float) -> Array:
    """Poses of an inaccurate robot: errors of equal size in different directions."""
    rng = np.random.default_rng(5)
    out = np.array(poses)
    for T in out:
        a, b = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        T[:3, :3] = Rotation.from_rotvec(turn_rad * a).as_matrix() @ T[:3, :3]
        T[:3, 3] += place_m * b
    return out


def true_spheres(made: Scene, image: int, located: LocatedOutlines) -> list[tuple[int, float]]:
    """Sphere and distance (px) from its true direction, for every outline of an image."""
    truth = made.centres_camera(image, EVERYTHING)
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    out: list[tuple[int, float]] = []
    for outline in located.outlines[image]:
        off = np.linalg.norm(truth - outline.cone.axis, axis=1) * made.camera.fx
        out.append((int(np.argmin(off)), float(off.min())))
    return out


@pytest.mark.slow
@pytest.mark.parametrize(
    "poses",
    [pytest.param("true", marks=pytest.mark.sweep), "robot", pytest.param("no scale", marks=pytest.mark.sweep)],
)
def test_as_good_as_the_search_of_whole_images(captured: Captured, poses: str) -> None:
    made, paths, whole = captured
    given_poses = np.array(made.T_world_camera)
    if poses == "robot":
        given_poses = erring(given_poses, 2e-3, np.radians(0.2))
    if poses == "no scale":
        given_poses[:, :3, 3] /= 3.3
    seen: list[tuple[int, int]] = []
    located = locate_outlines(
        paths,
        PosedImages(given_poses, made.camera, metric=poses != "no scale"),
        ScanSpheres(REGISTRATION_M, RADIUS_M, control_m=CONTROL_M),
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen == [(k, N) for k in range(1, N + 1)]
    assert located.count("predicted") == N
    assert located.assignments is not None
    for i, assignment in enumerate(located.assignments):
        found = true_spheres(made, i, located)
        assert all(off < 1.0 for _, off in found)
        assert len({sphere for sphere, _ in found}) == len(found)
        named = {d: sphere for d, (sphere, _) in enumerate(found) if sphere < len(REGISTRATION_M)}
        assert assignment.markers == named
        # Every sphere found in the whole image is found here too.
        for outline in whole[i]:
            off = min(float(np.linalg.norm(o.cone.axis - outline.cone.axis)) for o in located.outlines[i])
            assert off * made.camera.fx < 0.5
    scale = poses == "no scale"
    ours = register_images(
        located.outlines,
        PosedImages(given_poses, made.camera, metric=not scale),
        ScanSpheres(REGISTRATION_M, RADIUS_M),
        assignments=located.assignments,
    )
    theirs = register_images(
        whole, PosedImages(given_poses, made.camera, metric=not scale), ScanSpheres(REGISTRATION_M, RADIUS_M)
    )
    assert len(ours.registration.residuals) >= len(theirs.registration.residuals)
    # Pose errors shift the registration whatever the outlines: exact outlines of the same spheres show how far.
    best = perfect(made, located, given_poses, scale)
    centre = REGISTRATION_M.mean(axis=0)
    off = apply(ours.registration.T_world_scan, centre) - apply(best.registration.T_world_scan, centre)
    outlines_m = 3 * OUTLINE_PX * SCENE_M / made.camera.fx / np.sqrt(len(best.registration.residuals))
    truth = inverse(made.T_world_scan) @ made.T_world_camera
    error_m, best_m = (true_error_m(r.registration.T_scan_camera, truth, centre) for r in (ours, best))
    # Slightly different outlines weight the poses differently: allow a tenth of these poses' own error.
    assert np.linalg.norm(off) < outlines_m + 0.1 * best_m
    assert error_m < 3 * ours.registration.sigma_at_m(centre)


def perfect(made: Scene, located: LocatedOutlines, poses: Array, scale: bool) -> PipelineResult:
    """The registration with exact outlines of the registration spheres that were located."""
    assert located.assignments is not None
    outlines: list[tuple[SphereOutline, ...]] = []
    for i, assignment in enumerate(located.assignments):
        exact, spheres = exact_outlines(made, i, REGISTRATION_M, margin_px=-40)  # including spheres that are cut off
        by_sphere = dict(zip(spheres, exact, strict=True))
        outlines.append(tuple(by_sphere[m] for m in assignment.markers.values()))
    known = [dataclasses.replace(a, markers=dict(enumerate(a.markers.values()))) for a in located.assignments]
    return register_images(
        outlines,
        PosedImages(poses, made.camera, metric=not scale),
        ScanSpheres(REGISTRATION_M, RADIUS_M),
        assignments=known,
    )


@pytest.mark.slow
def test_spheres_that_no_list_names_are_found_too(captured: Captured) -> None:
    made, paths, _ = captured
    located = locate_outlines(
        paths, PosedImages(made.T_world_camera, made.camera), ScanSpheres(REGISTRATION_M, RADIUS_M)
    )
    spheres = {sphere for i in range(N) for sphere, off in true_spheres(made, i, located) if off < 1.0}
    assert len({10, 11, 12} & spheres) >= 2  # of those that two anchors show
    assert located.assignments is not None
    assert all(m < len(REGISTRATION_M) for a in located.assignments for m in a.markers.values())


@pytest.mark.slow
def test_an_image_that_shows_nothing_is_searched_whole(captured: Captured, tmp_path: Path) -> None:
    made, paths, _ = captured
    anchors = spread_views(made.T_world_camera, np.arange(N), 4)
    blank = next(i for i in range(N) if i not in anchors)
    empty = tmp_path / "blank.png"
    assert cv2.imwrite(str(empty), np.full((made.camera.height, WIDTH, 3), 90, np.uint8))
    files = [empty if i == blank else path for i, path in enumerate(paths)]
    located = locate_outlines(
        files, PosedImages(made.T_world_camera, made.camera), ScanSpheres(REGISTRATION_M, RADIUS_M)
    )
    assert located.images[blank].how == "searched"
    assert located.outlines[blank] == ()
    assert located.count("predicted") == N - 1


@pytest.mark.slow
def test_poses_of_other_images_predict_nothing(captured: Captured) -> None:
    made, paths, whole = captured
    turned = np.roll(made.T_world_camera, 3, axis=0)
    located = locate_outlines(paths, PosedImages(turned, made.camera), ScanSpheres(REGISTRATION_M, RADIUS_M))
    assert located.assignments is None
    assert located.count("searched") == N
    assert [len(found) for found in located.outlines] == [len(found) for found in whole]


def test_bad_arguments(captured: Captured, tmp_path: Path) -> None:
    made, paths, _ = captured
    with pytest.raises(DataError, match="poses"):
        locate_outlines(
            paths, PosedImages(made.T_world_camera[:2], made.camera), ScanSpheres(REGISTRATION_M, RADIUS_M)
        )
    with pytest.raises(DataError, match=r"missing\.jpg"):
        locate_outlines(
            [tmp_path / "missing.jpg"] * N,
            PosedImages(made.T_world_camera, made.camera),
            ScanSpheres(REGISTRATION_M, RADIUS_M),
        )


def test_what_is_not_where_it_is_predicted_is_missing(captured: Captured) -> None:
    """A marker moved since the scan, one removed, one of another colour: none is forced into the registration."""
    made, _, whole = captured
    centres = made.centres_camera(0, EVERYTHING)
    expected = PredictedSpheres(
        inverse(made.T_world_camera[0]) @ made.T_world_scan, EVERYTHING, RADIUS_M, WIDE, tone_of(whole[0])
    )
    shown = list(visible_cones(expected.T_camera_scan, EVERYTHING, RADIUS_M, made.camera))
    moved, gone, blue = shown[0], shown[2], shown[4]
    there = np.array(centres)
    there[moved] += 0.3 * RADIUS_M * np.array([0.7, 0.7, 0.0])
    plain = [i for i in range(len(there)) if i not in (gone, blue)]
    picture = render(made.camera, there[plain], 0, oversample=2)
    other = render(made.camera, there[[blue]], 0, oversample=2, colour=(0.7, 0.2, 0.1))
    inside = (
        np.linalg.norm(
            np.indices(picture.shape[:2])[::-1].transpose(1, 2, 0) - made.camera.project(there[[blue]])[0], axis=2
        )
        < 1.3 * made.camera.fx * RADIUS_M / there[blue, 2]
    )
    picture[inside] = other[inside]
    located = locate_predicted(picture, made.camera, expected)
    assert set(located.missing) == {moved, gone, blue}
    assert set(located.outlines) == set(shown) - {moved, gone, blue}
    assert "colour" in located.missing[blue]


def test_spheres_without_a_vote_change_no_outline_of_the_others(captured: Captured) -> None:
    """Control spheres, here displaced by 0.5 mm, had helped to choose the outlines that they are to judge."""
    made, _, whole = captured
    there = np.array(made.centres_camera(0, EVERYTHING))
    first = len(REGISTRATION_M)
    there[first:] += 5e-4 * np.array([0.7, 0.7, 0.0])
    picture = render(made.camera, there, 0, oversample=2)
    T = inverse(made.T_world_camera[0]) @ made.T_world_scan
    both = PredictedSpheres(T, EVERYTHING, RADIUS_M, NEAR, tone_of(whole[0]), first)
    alone = locate_predicted(picture, made.camera, dataclasses.replace(both, centres_m=REGISTRATION_M))
    beside = locate_predicted(picture, made.camera, both)
    assert np.array_equal(alone.T_camera_scan, beside.T_camera_scan)
    for m, outline in alone.outlines.items():
        assert np.linalg.norm(beside.outlines[m].cone.axis - outline.cone.axis) * made.camera.fx < 0.01
    for m in set(beside.outlines) - set(alone.outlines):
        off = beside.outlines[m].cone.axis - there[m] / np.linalg.norm(there[m])
        assert np.linalg.norm(off) * made.camera.fx < 0.6


def test_a_sphere_behind_another_or_outside_is_not_expected() -> None:
    cam = camera(WIDTH)
    T = np.eye(4)
    centres = np.array([[0.0, 0, 0.6], [0.0, 0.002, 0.75], [0.5, 0, 0.6], [0.1, 0, -0.6], [0.1, 0.05, 0.6]])
    assert set(visible_cones(T, centres, RADIUS_M, cam)) == {0, 4}


def test_anchors_are_spread(captured: Captured) -> None:
    poses = np.array(
        [look_at(np.array([x, 0.0, 0.6]), np.zeros(3), np.array([0.0, 1, 0])) for x in np.arange(9) / 10]
    )
    assert sorted(spread_views(poses, np.arange(9), 3)) == [0, 4, 8]
    assert spread_views(poses, np.array([2, 3]), 5) in ([2, 3], [3, 2])


def test_reduced_image_and_its_camera(tmp_path: Path) -> None:
    made = scene(1, 1203, seed=3)  # odd: the last column of the reduced image covers fewer pixels
    picture = render(made.camera, made.centres_camera(0, REGISTRATION_M), 0, oversample=2)
    path = tmp_path / "view.jpg"
    assert cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, 97])
    image, smaller = read_reduced(path, made.camera, 600)
    assert image.shape[:2] == (smaller.height, smaller.width) == (401, 602)
    found = detect_spheres(image, smaller)
    truth = made.centres_camera(0, REGISTRATION_M)
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    assert len(found) >= 4
    off = [np.linalg.norm(truth - o.cone.axis, axis=1).min() * smaller.fx for o in found]
    assert np.median(off) < 0.15
    with pytest.raises(DataError, match=r"1203×802.*view\.jpg"):
        read_reduced(path, dataclasses.replace(made.camera, width=1300, height=900), 600)
    assert np.array_equal(read_reduced(path, made.camera, 1000)[0], read_image(path))


@settings(max_examples=40, deadline=None)
@given(
    turn=st.tuples(*[st.floats(-0.02, 0.02)] * 3), shift=st.tuples(*[st.floats(-0.008, 0.008)] * 3),
    false=st.integers(0, 9),
)  # fmt: skip
def test_pose_from_cones_in_spite_of_a_false_one(
    turn: tuple[float, float, float], shift: tuple[float, float, float], false: int
) -> None:
    true = inverse(look_at(np.array([0.1, -0.2, 0.62]), np.array([0, 0, 0.05]), np.array([0.0, 1, 0])))
    cones = ObservedCones.of(cone_of_sphere(c, RADIUS_M) for c in apply(true, REGISTRATION_M))
    axes = cones.axes
    axes[false] += [0.01, -0.008, 0.0]
    axes[false] /= np.linalg.norm(axes[false])
    start = transform(Rotation.from_rotvec(turn), np.array(shift)) @ true
    found = fit_pose(cones, REGISTRATION_M, RADIUS_M, start, 60)
    assert np.linalg.norm(apply(found, REGISTRATION_M) - apply(true, REGISTRATION_M), axis=1).max() < 2e-4
