"""The error budget of a data set: predicted contributions by source, checked against observations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from service.compute.evaluation.closure import (
    Alignment,
    Closure,
    TriangulatedSphere,
    compare_in_frame,
    compare_shapes,
)
from service.core.geometry import Array

CONTROL_SPHERES = "control spheres"
HONEST = (0.5, 2.0)  # range of normalised chi square in which the covariances agree with the observation

_HOW = {
    "outlines": "covariances of the outlines from their edge points, scaled to the residuals",
    "common": "errors that all outlines of the capture may share (edge bias)",
    "intrinsics": "covariance of the camera calibration, poses fixed (poses from the same images absorb part)",
    "unexplained": "how far the scan moves if the errors that all outlines share are left free, and bias by blur",
    "outlines and poses": "covariances of the outlines, scaled to the residuals, each camera pose refined by its own",
    "poses": "covariance of the camera poses, their scatter estimated from the spheres' residuals",
    "spheres": "covariances of the sphere centres in the scan",
    "adjustment": "covariance of the joint adjustment of tracks, robot poses and sphere outlines",
}


@dataclass(frozen=True, slots=True)
class Contribution:
    """One source of error at the target, as a 3D standard deviation, and how it was determined."""

    name: str
    sigma_m: float
    how: str
    counted: bool = True  # in the total


@dataclass(frozen=True, slots=True)
class Observation:
    """A comparison of independent measurements with its predicted size."""

    name: str
    observed_m: float
    predicted_m: float
    normalised_chi2: float
    n: int
    how: str
    hides_common: bool = False  # errors common to all spheres cancel in this comparison

    @property
    def verdict(self) -> str:
        """Whether the stated covariances agree with the observation, in words."""
        low, high = HONEST
        if self.normalised_chi2 > high:
            factor = float(np.sqrt(self.normalised_chi2))
            return f"larger than predicted: the stated errors are {factor:.1f} times too small here"
        if self.normalised_chi2 < low and self.hides_common:
            return "smaller than predicted: errors common to all spheres do not show here"
        if self.normalised_chi2 < low:
            factor = float(1 / np.sqrt(max(self.normalised_chi2, 1e-12)))
            return f"smaller than predicted: the stated errors are {factor:.1f} times too large here"
        return "as predicted"


@dataclass(frozen=True, slots=True)
class MeasuredSpheres:
    """Sphere centres (n, 3) of a scan or a CT in its own frame, covariances (n, 3, 3), and the fit's residual."""

    centres_m: Array
    covariance_m2: Array
    surface_rms_m: float  # rms distance of the surface points from the fitted spheres


@dataclass(frozen=True, slots=True)
class ErrorBudget:
    """Contributions, their root sum of squares, and the observations that check them."""

    contributions: tuple[Contribution, ...]
    observations: tuple[Observation, ...]

    @property
    def total_m(self) -> float:
        """Root sum of squares of the counted contributions, metres."""
        return float(np.sqrt(sum(c.sigma_m**2 for c in self.contributions if c.counted)))


def contributions(
    registration_m: Mapping[str, float], scan: MeasuredSpheres, ct: MeasuredSpheres | None
) -> tuple[Contribution, ...]:
    """Every source of error at a target; `registration_m` holds the registration's components there, as 3D sigmas.

    The total is for a point of the scan's surface in the images: the registration's components and the scan's own
    noise. The CT is listed but not counted, since it only matters where its surface is used.
    """
    out = [
        Contribution(name, sigma_m, _HOW.get(name, "component of the registration's covariance"))
        for name, sigma_m in registration_m.items()
    ]
    out.append(
        Contribution("scan", scan.surface_rms_m, "rms distance of the scan's points on the spheres from the spheres")
    )
    if ct is not None:
        how = "rms distance of the CT surface on the spheres from the spheres; counts only where the CT is used"
        out.append(Contribution("ct", ct.surface_rms_m, how, counted=False))
    return tuple(out)


def control_observation(
    registration: Alignment, seen: Mapping[int, TriangulatedSphere], control: MeasuredSpheres
) -> Observation:
    """Control spheres located in the images, compared with their positions by scan and registration.

    Control and registration spheres are seen by the same camera, so an error that moves all outlines alike moves both
    and cancels.

    Args:
        registration: T_world_scan with its covariance, without such common errors.
        seen: spheres located in the images through the registered cameras, by index into `control`; scan frame.
        control: measured by the scanner; scan frame.
    """
    index = sorted(seen)
    R = registration.T_a_b[:3, :3]
    uncertain = R.T @ registration.covariance_at_m2(control.centres_m[index]) @ R
    closure = compare_in_frame(
        np.array([seen[m].centre_m for m in index]),
        np.array([seen[m].covariance_m2 for m in index]),
        control.centres_m[index],
        uncertain + control.covariance_m2[index],
    )
    how = "spheres that took no part in the registration, located in the images alone"
    return replace(_observation(CONTROL_SPHERES, closure, how), hides_common=True)


def loop_observations(
    seen: Mapping[int, TriangulatedSphere], scan: MeasuredSpheres, ct_in_scan_order: MeasuredSpheres | None
) -> tuple[Observation, ...]:
    """Closures camera ↔ scan, scan ↔ CT and camera ↔ CT: shapes of the spheres that each pair shares.

    Three pairs instead of one loop, because alignments on the same spheres cancel one another whatever their errors.

    Args:
        seen: spheres located in the images, by index into the scan's spheres.
        scan: the spheres of the registered scan.
        ct_in_scan_order: the CT's spheres, one for each of the scan's; rows of NaN where the CT has none.
    """
    index = sorted(seen)
    images = MeasuredSpheres(
        np.array([seen[m].centre_m for m in index]), np.array([seen[m].covariance_m2 for m in index]), 0.0
    )
    out: list[Observation] = []
    if len(index) >= 4:
        out.append(_shapes("camera ↔ scan", images, _pick(scan, index)))
    if ct_in_scan_order is None:
        return tuple(out)
    known = np.all(np.isfinite(ct_in_scan_order.centres_m), axis=1).tolist()
    both = [m for m, there in enumerate(known) if there]
    if len(both) >= 4:
        out.append(_shapes("scan ↔ CT", _pick(scan, both), _pick(ct_in_scan_order, both)))
    shared = [m for m in index if known[m]]
    if len(shared) >= 4:
        rows = [index.index(m) for m in shared]
        out.append(_shapes("camera ↔ CT", _pick(images, rows), _pick(ct_in_scan_order, shared)))
    return tuple(out)


def _pick(spheres: MeasuredSpheres, index: Sequence[int]) -> MeasuredSpheres:
    rows = list(index)
    return MeasuredSpheres(spheres.centres_m[rows], spheres.covariance_m2[rows], spheres.surface_rms_m)


def _shapes(name: str, a: MeasuredSpheres, b: MeasuredSpheres) -> Observation:
    closure, _ = compare_shapes(a.centres_m, a.covariance_m2, b.centres_m, b.covariance_m2)
    return _observation(name, closure, f"{closure.n} sphere centres after the best rigid alignment")


def _observation(name: str, closure: Closure, how: str) -> Observation:
    return Observation(name, closure.rms_m, closure.predicted_m, closure.normalised_chi2, closure.n, how)
