"""Where a scan covers a CT: by distance, by the direction of the surfaces, and away from the scan's rim."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.compute.surfaces.overlap import Mask, OverlapLimits, WoundLimits, overlap, propose_wound
from service.compute.surfaces.surface import Surface
from service.core.geometry import transform


def sheet(side: int = 21, *, height_m: float = 0.0, spacing_m: float = 0.001, seen_from: int = 1) -> Surface:
    """A square sheet around the origin, whose outward side is up, or down."""
    k = np.arange(side)
    x, y = np.meshgrid(k - (side - 1) / 2, k - (side - 1) / 2, indexing="ij")
    vertices = np.column_stack([spacing_m * x.ravel(), spacing_m * y.ravel(), np.full(side**2, height_m)])
    a = (k[:-1, None] * side + k[None, :-1]).ravel()
    faces = np.concatenate([np.column_stack([a, a + side, a + 1]), np.column_stack([a + 1, a + side, a + side + 1])])
    return Surface(vertices, faces[:, ::seen_from].astype(np.int64))


CT = sheet()
LARGE = 61  # a scan that reaches far beyond the CT, so that its rim is not near


def test_a_sheet_is_seen_from_above() -> None:
    assert np.allclose(CT.vertex_normals, [0, 0, 1])


@pytest.mark.parametrize(
    ("height_m", "covered"), [(0.0014, True), (-0.0014, True), (0.0016, False), (-0.0016, False)]
)
def test_the_scan_covers_as_far_as_it_is_near(height_m: float, covered: bool) -> None:
    found = overlap(CT, sheet(LARGE, height_m=height_m))
    assert (found.covered == covered).all()
    assert np.allclose(found.offset_m, -height_m)  # of the CT above the scan
    assert np.allclose(found.nearest_m, CT.vertices_m + np.array([0, 0, height_m]))
    assert (overlap(CT, sheet(LARGE, height_m=height_m), OverlapLimits(distance_m=0.003)).covered).all()
    assert not (overlap(CT, sheet(LARGE, height_m=height_m), OverlapLimits(distance_m=0.001)).covered).any()


def test_what_is_far_away_has_no_nearest_place() -> None:
    found = overlap(CT, sheet(LARGE, height_m=0.05))
    assert not found.covered.any()
    assert np.isinf(found.offset_m).all()
    assert np.array_equal(found.nearest_m, CT.vertices_m)


def test_the_back_of_a_scan_covers_nothing() -> None:
    assert not overlap(CT, sheet(LARGE, seen_from=-1)).covered.any()


@pytest.mark.parametrize(("tilt_deg", "cosine", "covered"), [(55, 0.5, True), (65, 0.5, False), (65, 0.4, True)])
def test_a_scan_at_too_steep_an_angle_covers_nothing(tilt_deg: float, cosine: float, covered: bool) -> None:
    turned = sheet(LARGE).moved(transform(Rotation.from_euler("x", tilt_deg, degrees=True), np.zeros(3)))
    at_the_crossing = np.abs(CT.vertices_m[:, 1]) < 5e-4
    found = overlap(CT, turned, OverlapLimits(cosine=cosine)).covered
    assert (found[at_the_crossing] == covered).all()


@pytest.mark.parametrize("rim_m", [0.001, 0.0035])
def test_a_strip_along_the_scans_rim_is_not_used(rim_m: float) -> None:
    """The scan ends inside the CT: 6 mm from its middle on either side."""
    found = overlap(CT, sheet(13), OverlapLimits(rim_m=rim_m)).covered
    from_rim_m = 0.006 - np.abs(CT.vertices_m[:, :2]).max(axis=1)
    assert found[from_rim_m > rim_m + 1e-6].all()
    assert not found[from_rim_m < rim_m - 1e-6].any()
    default = overlap(CT, sheet(13)).covered
    assert np.array_equal(default, overlap(CT, sheet(13), OverlapLimits(rim_m=0.001)).covered)


# --- wounds ----------------------------------------------------------------------------------------------

RADIUS_M, DEPTH_M = 0.012, 0.008


def bowl(sign: int = 1) -> tuple[Surface, Mask]:
    """A sheet with a hollow (or a hill) of 12 mm radius in its middle, which the scan lacks."""
    flat = sheet(41)
    across_m = np.linalg.norm(flat.vertices_m[:, :2], axis=1)
    height = -sign * DEPTH_M * np.maximum(1 - (across_m / RADIUS_M) ** 2, 0.0)
    return Surface(flat.vertices_m + height[:, None] * [0, 0, 1], flat.faces), across_m >= RADIUS_M


def proposed(limits: WoundLimits, sign: int = 1, up: tuple[float, float, float] = (0, 0, 2)) -> bool:
    surface, covered = bowl(sign)
    wound = propose_wound(surface, covered, np.array(up), limits)
    assert not wound.any() or np.array_equal(wound, ~covered)
    return bool(wound.any())


def test_a_hollow_that_the_scan_lacks_is_a_wound_from_its_least_area_and_depth_on() -> None:
    surface, covered = bowl()
    area_m2 = sum(
        float(np.linalg.norm(surface.area_vectors_m2[face])) / 3
        for face, corners in enumerate(surface.faces)
        for corner in corners
        if not covered[corner]
    )
    assert 1.2 * np.pi * RADIUS_M**2 < area_m2 < 2.5 * np.pi * RADIUS_M**2
    alike = WoundLimits(closing_m=1e-4, least_depth_m=0.001, least_facing=0.2)
    assert proposed(dataclasses.replace(alike, least_area_m2=0.95 * area_m2))
    assert not proposed(dataclasses.replace(alike, least_area_m2=1.05 * area_m2))
    small = dataclasses.replace(alike, least_area_m2=1e-5)
    # The mean depth of a paraboloid is half of that of its middle, and less from a rim that lies below the sheet.
    assert proposed(dataclasses.replace(small, least_depth_m=0.25 * DEPTH_M))
    assert not proposed(dataclasses.replace(small, least_depth_m=0.55 * DEPTH_M))
    assert not proposed(small, sign=-1), "a hill"
    assert not proposed(small, up=(0, 0, -1)), "seen from below it is a hill too"


def test_nothing_is_proposed_where_nothing_lacks() -> None:
    surface, covered = bowl()
    assert not propose_wound(surface, np.ones_like(covered), np.array([0.0, 0.0, 1.0])).any()
