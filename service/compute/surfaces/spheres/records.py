"""Located spheres as plain data, in the files and results of this project."""

from __future__ import annotations

from typing import Any

import numpy as np

from service.compute.surfaces.spheres.mesh_spheres import MeshSphere
from service.core.units import mm


def sphere_record(sphere: MeshSphere) -> dict[str, Any]:
    """One sphere: lengths in the unit that each key names, the covariance in m²."""
    return {
        "centre_m": sphere.centre_m.tolist(),
        "covariance_m2": sphere.covariance.tolist(),
        "sigma_mm": mm(float(np.sqrt(np.trace(sphere.covariance)))),
        "rms_mm": mm(sphere.rms_m),
        "radius_residual_mm": mm(sphere.radius_residual_m),
        "radius_sigma_mm": mm(sphere.radius_sigma_m),
        "coverage": sphere.coverage,
        "n_points": sphere.n,
    }


def spheres_document(spheres: tuple[MeshSphere, ...], radius_m: float) -> dict[str, Any]:
    """The content of spheres.json: centres as `read_spheres_json` reads them, and under `details`, in the same order,
    what each is worth."""
    return {
        "radius_mm": mm(radius_m),
        "registration_mm": [mm(sphere.centre_m).tolist() for sphere in spheres],
        "control_mm": [],
        "details": [sphere_record(sphere) for sphere in spheres],
    }
