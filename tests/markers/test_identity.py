"""Identity of spheres: hypotheses from one image, verified over the image set."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from service.compute.markers.records import SphereOutline
from service.compute.registration.identity import identify, identify_each
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError
from service.core.geometry import Array, transform
from tests.support.scenes.sphere_images import (
    CONTROL_M,
    RADIUS_M,
    REGISTRATION_M,
    Scene,
    exact_outlines,
    false_outlines,
    scene,
)

EVERYTHING = np.vstack([REGISTRATION_M, CONTROL_M])


def noisy_set(
    made: Scene, seed: int, noise_px: float = 0.1, n_false: int = 2
) -> tuple[list[tuple[SphereOutline, ...]], list[dict[int, int]]]:
    """Outlines of all images with false ones added, and the true markers (control spheres belong to none)."""
    outlines: list[tuple[SphereOutline, ...]] = []
    truth: list[dict[int, int]] = []
    for i in range(len(made.T_world_camera)):
        real, ids = exact_outlines(made, i, EVERYTHING, noise_px, seed)
        outlines.append(real + false_outlines(made.camera, n_false, seed * 50 + i))
        truth.append({j: k for j, k in enumerate(ids) if k < 10})
    return outlines, truth


def wrong(found: dict[int, int], truth: dict[int, int]) -> dict[int, int]:
    return {d: m for d, m in found.items() if truth.get(d) != m}


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 10_000))
def test_every_marker_of_a_set_is_named_right(seed: int) -> None:
    made = scene(5, seed=seed)
    outlines, truth = noisy_set(made, seed)
    found = identify(outlines, PosedImages(made.T_world_camera, made.camera), ScanSpheres(REGISTRATION_M, RADIUS_M))
    for a, t in zip(found, truth, strict=True):
        assert a.markers == t


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.05, 20.0))
@example(seed=17, scale=3.0)  # only one image shows four spheres
def test_scale_of_structure_from_motion_is_found(seed: int, scale: float) -> None:
    made = scene(6, seed=seed)
    outlines, truth = noisy_set(made, seed)
    A = transform(Rotation.random(rng=np.random.default_rng(seed)), np.array([1.0, 2.0, -3.0]))
    poses = A @ made.T_world_camera
    poses[:, :3, 3] /= scale
    if sum(len(t) >= 4 for t in truth) < 2:  # about one set in sixty: refused, not guessed
        with pytest.raises(ComputeError, match=r"from one image|no image shows four"):
            identify(outlines, PosedImages(poses, made.camera, metric=False), ScanSpheres(REGISTRATION_M, RADIUS_M))
        return
    found = identify(outlines, PosedImages(poses, made.camera, metric=False), ScanSpheres(REGISTRATION_M, RADIUS_M))
    for a, t in zip(found, truth, strict=True):
        assert not wrong(a.markers, t)
        assert len(a.markers) >= len(t) - 1
        assert a.scale == pytest.approx(scale, rel=0.01)


def four_of_ten(seed: int) -> tuple[Scene, tuple[SphereOutline, ...], dict[int, int]] | None:
    made = scene(1, seed=seed)
    real, ids = exact_outlines(made, 0, REGISTRATION_M, 0.15, seed)
    if len(real) < 4:
        return None
    return made, real[:4] + false_outlines(made.camera, 3, seed), dict(enumerate(ids[:4]))


def test_four_of_ten_among_three_false_without_poses() -> None:
    cases = [c for c in (four_of_ten(seed) for seed in range(60)) if c is not None]
    assert len(cases) > 30
    named = refused = 0
    for made, outlines, truth in cases:
        try:
            (a,) = identify_each([outlines], made.camera, ScanSpheres(REGISTRATION_M, RADIUS_M))
        except ComputeError:
            refused += 1
            continue
        assert not wrong(a.markers, truth)
        named += len(a.markers) == 4
    assert named >= 0.99 * len(cases), refused


def test_an_image_with_two_spheres_is_named_through_the_poses() -> None:
    made = scene(4, seed=3)
    outlines, truth = noisy_set(made, 3, n_false=0)
    chosen = list(truth[1])[:2]
    outlines[1] = tuple(outlines[1][d] for d in chosen)
    found = identify(outlines, PosedImages(made.T_world_camera, made.camera), ScanSpheres(REGISTRATION_M, RADIUS_M))
    assert [found[1].markers[k] for k in (0, 1)] == [truth[1][d] for d in chosen]


def test_poses_off_by_a_millimetre_are_met() -> None:
    made = scene(6, seed=5)
    rng = np.random.default_rng(0)
    outlines, truth = noisy_set(made, 5)
    poses = np.array(
        [T @ transform(Rotation.from_rotvec(rng.normal(size=3) * 1e-3), rng.normal(size=3) * 6e-4)
         for T in made.T_world_camera]
    )  # fmt: skip
    found = identify(outlines, PosedImages(poses, made.camera), ScanSpheres(REGISTRATION_M, RADIUS_M))
    assert all(not wrong(a.markers, t) and len(a.markers) == len(t) for a, t in zip(found, truth, strict=True))


def test_stations_are_solved_in_their_own_frames() -> None:
    made = scene(6, seed=6)
    outlines, truth = noisy_set(made, 6)
    moved = np.array(made.T_world_camera)
    moved[3:] = transform(Rotation.from_rotvec([0, 0, 2.0]), np.array([0.5, 1.2, 0.0])) @ moved[3:]
    found = identify(
        outlines, PosedImages(moved, made.camera, groups=[0, 0, 0, 1, 1, 1]), ScanSpheres(REGISTRATION_M, RADIUS_M)
    )
    assert all(a.markers == t for a, t in zip(found, truth, strict=True))


def test_symmetric_layout_is_called_ambiguous() -> None:
    angle = np.arange(6) * np.pi / 3
    ring: Array = np.stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), np.full(6, 0.05)], axis=1)
    made = scene(4, seed=1)
    outlines = [exact_outlines(made, i, ring)[0] for i in range(4)]
    with pytest.raises(ComputeError, match="ambiguous"):
        identify(outlines, PosedImages(made.T_world_camera, made.camera), ScanSpheres(ring, RADIUS_M))


def test_one_image_that_can_be_read_in_two_ways_names_them() -> None:
    angle = np.arange(6) * np.pi / 3
    ring: Array = np.stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), np.full(6, 0.05)], axis=1)
    made = scene(1, seed=1)
    outlines = exact_outlines(made, 0, ring)[0]
    with pytest.raises(ComputeError, match=r"ambiguous: \{0=\d, .*\} and \{0=\d"):
        identify_each([outlines], made.camera, ScanSpheres(ring, RADIUS_M))


def test_too_few_says_how_many_where() -> None:
    made = scene(2, seed=1)
    outlines = [exact_outlines(made, i, EVERYTHING)[0][:n] for i, n in ((0, 3), (1, 2))]
    with pytest.raises(ComputeError, match=r"at most 3 .*a\.jpg: 3, b\.jpg: 2"):
        identify(
            outlines,
            PosedImages(made.T_world_camera, made.camera, names=["a.jpg", "b.jpg"]),
            ScanSpheres(REGISTRATION_M, RADIUS_M),
        )


def test_spheres_of_another_scene_are_refused() -> None:
    made = scene(4, seed=2)
    outlines = [exact_outlines(made, i, REGISTRATION_M)[0] for i in range(4)]
    other = np.random.default_rng(3).uniform(-0.2, 0.2, (10, 3))
    with pytest.raises(ComputeError):
        identify(outlines, PosedImages(made.T_world_camera, made.camera), ScanSpheres(other, RADIUS_M))


def test_poses_of_other_images_are_refused() -> None:
    made = scene(6, seed=4)
    outlines = [exact_outlines(made, i, REGISTRATION_M)[0] for i in range(6)]
    with pytest.raises(ComputeError, match="poses"):
        identify(outlines, PosedImages(made.T_world_camera[::-1], made.camera), ScanSpheres(REGISTRATION_M, RADIUS_M))
