"""The covariance of each pose of a data set, as far as the record states it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import ValidationError

from service.core.errors import IntegrityError
from service.core.geometry import Array, Transform, skew
from service.dataset.summary import RunSummary
from service.jobs.poses import hybrid
from service.jobs.registration.register import Registration

_FILE = "hybrid_poses"  # kind of the artefact that holds a HybridModel
_WHOLE = (
    "all of it, from the adjustment of images, robot and spheres together; the registration's share, which is common "
    "to all images, is in it"
)
_SHARED = "the share of the registration, which is common to all images; the record states none of single poses"
_BOTH = (
    "the share of the registration, which is common to all images, and that of the pose in the bundle adjustment, "
    "added as independent"
)


@dataclass(frozen=True, slots=True)
class ViewCovariances:
    """Covariances (6, 6) of T_scan_camera by viewpoint, as `View.covariance`, and what they hold, in words."""

    covariance: dict[str, Array]
    words: str


def view_covariances(
    summary: RunSummary, own: str, registered: Registration, names: Sequence[str], joint: Array | None
) -> ViewCovariances:
    """What the record states of the poses of the run's own registration.

    Hybrid poses have a covariance each. The others have that of the registration, seen from each camera, and with it
    that of the bundle adjustment, where there was one.

    Args:
        summary: the run.
        own: name of its registration.
        registered: that registration.
        names: viewpoints.
        joint: (6 N, 6 N) of their own errors, as `own_pose_errors` has it.

    Raises:
        IntegrityError: the recorded file of the hybrid poses is not one.
    """
    stated = _of_hybrid(summary) if own == hybrid.KIND.name else {}
    if set(names) <= set(stated):
        return ViewCovariances(stated, _WHOLE)
    T_world_scan, covariance = np.array(registered.T_world_scan), np.array(registered.covariance)
    found: dict[str, Array] = {}
    for k, name in enumerate(names):
        found[name] = pose_covariance(T_world_scan, covariance, np.array(registered.T_scan_camera[name]))
        if joint is not None:
            block = slice(6 * k, 6 * k + 6)
            found[name] = found[name] + joint[block, block]
    return ViewCovariances(found, _SHARED if joint is None else _BOTH)


def pose_covariance(T_world_scan: Transform, covariance: Array, T_scan_camera: Transform) -> Array:
    """(6, 6) covariance of T_scan_camera that the covariance (6 or 7, …) of T_world_scan causes.

    T_scan_camera = T_world_scan^-1 T_world_camera with the camera held: with R of T_world_scan and the vector a from
    its origin to the camera, in the world's axes, d_scan = R^T (a x w - d) and w_scan = -R^T w.
    """
    R = T_world_scan[:3, :3]
    J = np.zeros((6, 6))
    J[:3, :3], J[3:, 3:] = -R.T, -R.T
    J[:3, 3:] = R.T @ skew(R @ T_scan_camera[:3, 3])
    return J @ covariance[:6, :6] @ J.T


def _of_hybrid(summary: RunSummary) -> dict[str, Array]:
    """Of the newest hybrid poses from photographs at full size; empty if their covariance is in another frame."""
    jobs = [job for step in summary.state.steps.values() for job in step.jobs.values()]
    for job in sorted(jobs, key=lambda job: job.ended_seq, reverse=True):
        reduced = any(job.arguments.get(key) is not None for key in ("reduced_to", "full_camera"))
        ref = next((one for one in job.artefacts if one.kind == _FILE), None)
        if job.kind != hybrid.KIND.name or reduced or ref is None:
            continue
        try:
            model = hybrid.HybridModel.model_validate_json(summary.store.artefact_path(ref.sha256).read_bytes())
        except ValidationError as error:
            raise IntegrityError("the recorded hybrid poses cannot be read", where=ref.original_name) from error
        if model.pose_covariance_frame == "scan":
            return {name: np.array(covariance) for name, covariance in model.pose_covariance.items()}
    return {}
