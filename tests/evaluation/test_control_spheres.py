"""Control spheres count where they really are: displaced ones with their displacement, missing ones as missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from service.compute.markers.cones import cone_of_sphere
from service.compute.markers.predicted import find_nearby
from service.compute.markers.records import SphereOutline
from service.compute.registration.control_spheres import (
    ControlEvaluation,
    ExpectedNearby,
    SearchNearby,
    evaluate_controls,
)
from service.compute.registration.identity import Assignment
from service.compute.scene import PosedImages, ScanSpheres
from service.core.geometry import Array, inverse
from tests.support.scenes.sphere_images import (
    CONTROL_M,
    RADIUS_M,
    REGISTRATION_M,
    Scene,
    exact_outlines,
    render,
    scene,
)

N, FIRST = 9, len(REGISTRATION_M)
ASIDE = np.array([0.6, 0.7, -0.39]) / np.linalg.norm([0.6, 0.7, -0.39])
MADE = scene(N, width=1200, seed=4)


@dataclass(frozen=True)
class Seen:
    """What a detector found in images of a scene."""

    outlines: list[tuple[SphereOutline, ...]]
    taken: list[Assignment]
    controls: list[dict[int, int]]  # sphere → outline, of each image


def seen(control_m: Array, made: Scene = MADE) -> Seen:
    """Outlines of the scene with control spheres at these places."""
    found = [exact_outlines(made, i, np.vstack([REGISTRATION_M, control_m]), 0.05, seed=4) for i in range(N)]
    taken = [Assignment({j: k for j, k in enumerate(names) if k < FIRST}) for _, names in found]
    controls = [{k - FIRST: j for j, k in enumerate(names) if k >= FIRST} for _, names in found]
    return Seen([outlines for outlines, _ in found], taken, controls)


def evaluated(
    made: Seen, listed_m: Array, captures: Sequence[int] | None = None, search: SearchNearby | None = None
) -> ControlEvaluation:
    truth = inverse(MADE.T_world_scan) @ MADE.T_world_camera
    spheres = ScanSpheres(REGISTRATION_M, RADIUS_M, control_m=listed_m)
    return evaluate_controls(
        made.outlines, made.taken, PosedImages(truth, MADE.camera), spheres, captures=captures, search=search
    )


def displaced(by_mm: float) -> Array:
    moved = CONTROL_M.copy()
    moved[1] += 1e-3 * by_mm * ASIDE
    return moved


def without(made: Seen, gone: Sequence[tuple[int, int]]) -> Seen:
    """Without the outlines of these control spheres (image, sphere)."""
    outlines, taken, controls = list(made.outlines), list(made.taken), list(made.controls)
    for i, s in gone:
        if s not in controls[i]:
            continue
        lost = controls[i][s]
        outlines[i] = tuple(o for j, o in enumerate(outlines[i]) if j != lost)
        taken[i] = Assignment({j - (j > lost): m for j, m in taken[i].markers.items()})
        controls[i] = {k: j - (j > lost) for k, j in controls[i].items() if k != s}
    return Seen(outlines, taken, controls)


def test_the_figure_of_a_displaced_sphere_grows_with_its_displacement() -> None:
    clean = evaluated(seen(CONTROL_M), CONTROL_M)
    assert clean.findings == ()
    assert clean.measures()["worst_control_sphere_mm"] < 0.1
    before_mm = clean.spheres[1].radial_error_mm
    for by_mm in (0.5, 0.7, 1.0, 2.0, 5.0, 8.0, 10.0, 30.0):
        found = evaluated(seen(displaced(by_mm)), CONTROL_M)
        worst = found.spheres[1]
        assert worst.measured == worst.expected == clean.spheres[1].expected
        assert worst.radial_error_mm is not None
        assert before_mm is not None
        assert worst.radial_error_mm > before_mm
        before_mm = worst.radial_error_mm
        assert found.worst_mm == worst.radial_error_mm
        assert worst.displacement_mm == pytest.approx(by_mm, abs=0.1)
        assert f"control sphere 1 is {worst.displacement_mm:.2f} mm from where" in worst.finding
        assert [s.finding for s in found.spheres if s.index != 1] == ["", ""]


def test_a_sphere_that_no_image_shows_is_expected_and_missing() -> None:
    made = without(seen(CONTROL_M), [(i, 2) for i in range(N)])
    found = evaluated(made, CONTROL_M)
    assert found.measures()["control_spheres"] == 2
    assert found.measures()["control_spheres_expected"] == 3
    assert found.measures()["control_outlines_share"] == 0
    assert "control sphere 2 was found in none of the" in found.findings[0]


def test_a_sphere_in_few_of_its_images_is_told_with_both_counts() -> None:
    made = without(seen(CONTROL_M), [(i, 0) for i in range(2, N)])
    found = evaluated(made, CONTROL_M)
    assert f"measured in 2 of {found.spheres[0].expected} images" in found.spheres[0].finding
    assert found.least_share == 2 / found.spheres[0].expected


def test_all_spheres_off_alike_are_the_registrations_error() -> None:
    found = evaluated(seen(CONTROL_M + 2e-3 * ASIDE), CONTROL_M)
    assert len(found.findings) == 3
    assert all("the registration itself is off" in text for text in found.findings)


def test_a_capture_before_the_control_spheres_were_placed_expects_none() -> None:
    made = without(seen(CONTROL_M), [(i, s) for i in range(4) for s in range(3)])
    found = evaluated(made, CONTROL_M, captures=[0] * 4 + [1] * (N - 4))
    assert found.findings == ()
    assert max(s.expected for s in found.spheres) <= N - 4


def test_only_what_lacks_is_searched_and_wide_where_no_place_is_known() -> None:
    whole = seen(displaced(30.0))
    made = without(whole, [(i, 1) for i in range(N)])
    asked: list[int] = []

    def search(expected: ExpectedNearby) -> list[tuple[SphereOutline, ...]]:
        out: list[tuple[SphereOutline, ...]] = []
        for i, around in expected:
            asked.append(i)
            assert len(around) == 1
            cone, window_rad = around[0]
            sphere = whole.outlines[i][whole.controls[i][1]]
            assert np.linalg.norm(cone.axis - sphere.cone.axis) < window_rad
            out.append((sphere,))
        return out

    found = evaluated(made, CONTROL_M, search=search)
    assert len(asked) == found.spheres[1].expected == found.spheres[1].measured
    assert found.spheres[1].displacement_mm == pytest.approx(30, abs=0.1)
    asked.clear()
    evaluated(seen(CONTROL_M), CONTROL_M, search=search)
    assert asked == []


def test_an_image_without_a_pose_counts_as_if_it_were_not_there() -> None:
    made = seen(CONTROL_M)
    truth = inverse(MADE.T_world_scan) @ MADE.T_world_camera
    truth[3] = np.nan
    spheres = ScanSpheres(REGISTRATION_M, RADIUS_M, control_m=CONTROL_M)
    found = evaluate_controls(made.outlines, made.taken, PosedImages(truth, MADE.camera), spheres)
    assert found.findings == ()
    assert found.assignments[3].markers == {}


def test_a_sphere_centimetres_aside_is_found_in_the_picture() -> None:
    made = scene(1, width=720, seed=4)
    there = made.centres_camera(0, np.vstack([REGISTRATION_M, displaced(30.0)]))
    picture = render(made.camera, there, 0, oversample=2)
    expected = cone_of_sphere(made.centres_camera(0, CONTROL_M)[1], RADIUS_M)
    found = find_nearby(picture, made.camera, [(expected, 0.05 / 0.65)])
    true = there[FIRST + 1] / np.linalg.norm(there[FIRST + 1])
    assert min(float(np.linalg.norm(o.cone.axis - true)) for o in found) * made.camera.fx < 0.5
