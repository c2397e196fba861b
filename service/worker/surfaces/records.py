"""Located spheres and judged layouts as the records of jobs."""

from __future__ import annotations

import numpy as np

from service.compute.layout.ambiguity import BoundedLength, LayoutReport, layout_bounds
from service.compute.surfaces.mesh_spheres import MeshSphere
from service.core.records.events import Uncertainty
from service.core.units import deg, mm
from service.jobs.records import JudgedLayout, MeasuredSphere, SphereConfusion, matrix


def measured_sphere(sphere: MeshSphere) -> MeasuredSphere:
    """The record of a sphere found in a mesh."""
    x, y, z = sphere.centre_m.tolist()
    return MeasuredSphere(
        centre_m=(x, y, z),
        covariance_m2=matrix(sphere.covariance),
        sigma_mm=mm(float(np.sqrt(np.trace(sphere.covariance)))),
        rms_mm=mm(sphere.rms_m),
        radius_residual_mm=mm(sphere.radius_residual_m),
        radius_sigma_mm=mm(sphere.radius_sigma_m),
        coverage=sphere.coverage,
        n_points=sphere.n,
    )


def judged_layout(report: LayoutReport) -> JudgedLayout:
    """The record of a layout's report."""
    return JudgedLayout(
        passed=report.passed,
        problems=report.problems,
        margin_mm=mm(report.margin_m),
        margin_sigma_mm=mm(report.margin.sigma_m),
        bounds={name: _uncertainty(bounded) for name, (bounded, _) in layout_bounds(report).items()},
        margin_by_count_mm={str(k): mm(v) for k, v in report.margin_by_count_m.items() if np.isfinite(v)},
        worst=tuple(
            SphereConfusion(spheres=c.spheres, taken_for=c.taken_for, misfit_mm=mm(c.misfit_m)) for c in report.worst
        ),
        depth_mm=mm(report.depth.value_m),
        extent_mm=mm(report.extent_m),
        largest_gap_deg=deg(report.largest_gap_rad),
    )


def _uncertainty(length: BoundedLength) -> Uncertainty:
    return Uncertainty(sigma=mm(length.sigma_m), lower=mm(length.lower_m), upper=mm(length.upper_m))
