"""Computes the covariance of each pose of a data set, and their joint one, as far as the record states them."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import ValidationError

from service.computations.image_poses import HYBRID, HybridModel
from service.computations.registration import POSE_ERRORS, REGISTER, Registration
from service.core.errors import IntegrityError
from service.core.geometry import Array, Transform, skew
from service.core.jobs import jobs_of
from service.core.run.state import JobState
from service.core.units import mm, mrad
from service.dataset.summary import RunSummary


def own_pose_errors(summary: RunSummary, registered: Registration, names: Sequence[str]) -> Array | None:
    """Return the joint covariance (6 N, 6 N) of T_scan_camera of these viewpoints, without errors common to all.

    Stated for poses of structure from motion: the covariance of their bundle adjustment, after a similarity has
    aligned the positions with the true ones, in the scan's axes and in metres. The error of the scale is not in it,
    nor is that of the registration. None for other poses.

    Args:
        summary: the run.
        registered: one of its registrations.
        names: viewpoints, in the order of the rows.
    """
    tracks = _tracks(summary, registered)
    if tracks is None:
        return None
    joint = _joint(summary, tracks, "pose_covariance", names)
    R_scan_world = np.array(registered.T_world_scan)[:3, :3].T
    turned = np.zeros((6, 6))
    turned[:3, :3], turned[3:, 3:] = registered.scale * R_scan_world, R_scan_world
    J = np.kron(np.eye(len(names)), turned)
    return J @ joint @ J.T


def stated_pose_errors(summary: RunSummary, registered: Registration, names: Sequence[str]) -> Array | None:
    """Return (6 N, 6 N) joint covariance of T_scan_camera of these viewpoints, with that of the registration.

    Stated for poses of an arm and of the spheres. None for other poses, and in runs of earlier versions.

    Args:
        summary: the run.
        registered: one of its registrations.
        names: viewpoints, in the order of the rows.
    """
    made = _job(summary, registered)
    kept = [ref for ref in made.artefacts if ref.kind == POSE_ERRORS] if made is not None else []
    return _joint(summary, kept[0].sha256, "covariance", names) if kept else None


def _joint(summary: RunSummary, sha256: str, array: str, names: Sequence[str]) -> Array:
    """Return (6 N, 6 N) of these viewpoints, from a file that has their names beside the array."""
    with np.load(io.BytesIO(summary.store.artefact_path(sha256).read_bytes()), allow_pickle=False) as archive:
        order: list[str] = json.loads(str(archive["names"]))
        rows = (6 * np.array([order.index(name) for name in names])[:, None] + np.arange(6)).ravel()
        return np.asarray(archive[array], dtype=np.float64)[np.ix_(rows, rows)]


def _tracks(summary: RunSummary, registered: Registration) -> str | None:
    """Return the file with the tracks from which the poses of a registration were adjusted."""
    made = _job(summary, registered)
    tracks = None if made is None else made.arguments.get("tracks")
    return tracks if isinstance(tracks, str) else None


def _job(summary: RunSummary, registered: Registration) -> JobState | None:
    """Return the job that computed a registration."""
    finished = (job for job in jobs_of(summary.state).values() if job.status == "finished")
    made = (job for job in finished if job.kind == REGISTER.name)
    return next((job for job in made if REGISTER.read_answer(job.result) == registered), None)


_FILE = "hybrid_poses"  # kind of the artefact that holds a HybridModel
_WHOLE = (
    "all of it, from the adjustment of images, robot and spheres together; the registration's share, which is common "
    "to all images, is in it"
)
_ARM = (
    "all of it: the share of the registration and that of the arm, whose poses err by {mm:.3f} mm and {mrad:.3f} "
    "mrad along each axis, as the spheres show"
)
_REFINED = _ARM + "; the outlines of the spheres refined each pose, and the covariance is what they leave open"
_LOCATED = (
    "all of it: what the outlines of the spheres in each image leave open of its pose, and what all images share: "
    "errors of the spheres' centres in the scan, of the edges and of the lens"
)
_SHARED = "the share of the registration, which is common to all images; the record states none of single poses"
_BOTH = (
    "the share of the registration, which is common to all images, and that of the pose in the bundle adjustment, "
    "added as independent"
)


@dataclass(frozen=True, slots=True)
class ViewCovariances:
    """The recorded covariances of the errors of T_scan_camera.

    Attributes:
        covariance: (6, 6) by viewpoint, as `View.covariance`.
        words: a text on what they hold.
        joint: (6 N, 6 N) of all viewpoints, as `DataSet.pose_errors`; None where it is not known.
    """

    covariance: dict[str, Array]
    words: str
    joint: Array | None


def view_covariances(
    summary: RunSummary, own: str, registered: Registration, names: Sequence[str]
) -> ViewCovariances:
    """Return what the record states of the errors of the poses of the run's own registration.

    Hybrid poses have a covariance each, poses of an arm and of the spheres a joint one. The others have that of the
    registration, seen from each camera, and with it that of the bundle adjustment, where there was one. So have poses
    of an arm and of the spheres in runs of earlier versions, which did not state theirs.

    Args:
        summary: the run.
        own: the name of its registration.
        registered: that registration.
        names: viewpoints, in the order of the rows of the joint covariance.

    Raises:
        IntegrityError: the recorded file of the hybrid poses is not one.
    """
    stated = _of_hybrid(summary) if own == HYBRID.name else {}
    if set(names) <= set(stated):
        return ViewCovariances(stated, _WHOLE, None)
    whole = stated_pose_errors(summary, registered, names)
    if whole is not None:
        words = _LOCATED if registered.pose_sigma_m is None else _of_arm(registered)
        return ViewCovariances(dict(zip(names, _blocks(whole), strict=True)), words, whole)
    T_world_scan, covariance = np.array(registered.T_world_scan), np.array(registered.covariance)
    found = {
        name: pose_covariance(T_world_scan, covariance, np.array(registered.T_scan_camera[name])) for name in names
    }
    joint = own_pose_errors(summary, registered, names)
    if joint is None:
        return ViewCovariances(found, _SHARED, None)
    both = {name: found[name] + block for name, block in zip(names, _blocks(joint), strict=True)}
    return ViewCovariances(both, _BOTH, joint)


def _blocks(joint: Array) -> list[Array]:
    """Return (6, 6) of each pose from the joint covariance (6 N, 6 N)."""
    return [joint[k : k + 6, k : k + 6] for k in range(0, len(joint), 6)]


def _of_arm(registered: Registration) -> str:
    """Describe what the covariances of an arm's poses hold."""
    words = _ARM if registered.T_scan_camera_given is None else _REFINED
    return words.format(mm=mm(registered.pose_sigma_m or 0.0), mrad=mrad(registered.pose_sigma_rad or 0.0))


def pose_covariance(T_world_scan: Transform, covariance: Array, T_scan_camera: Transform) -> Array:
    """Return (6, 6) covariance of T_scan_camera that the covariance (6 or 7, …) of T_world_scan causes.

    T_scan_camera = T_world_scan^-1 T_world_camera with the camera held: with R of T_world_scan and the vector a from
    its origin to the camera, in the world's axes, d_scan = R^T (a x w - d) and w_scan = -R^T w.
    """
    R = T_world_scan[:3, :3]
    J = np.zeros((6, 6))
    J[:3, :3], J[3:, 3:] = -R.T, -R.T
    J[:3, 3:] = R.T @ skew(R @ T_scan_camera[:3, 3])
    return J @ covariance[:6, :6] @ J.T


def _of_hybrid(summary: RunSummary) -> dict[str, Array]:
    """Return the covariances of the newest hybrid poses from photographs at full size; none in other frames."""
    jobs = [job for step in summary.state.steps.values() for job in step.jobs.values()]
    for job in sorted(jobs, key=lambda job: job.ended_seq, reverse=True):
        reduced = any(job.arguments.get(key) is not None for key in ("reduced_to", "full_camera"))
        ref = next((one for one in job.artefacts if one.kind == _FILE), None)
        if job.kind != HYBRID.name or reduced or ref is None:
            continue
        try:
            model = HybridModel.model_validate_json(summary.store.artefact_path(ref.sha256).read_bytes())
        except ValidationError as error:
            raise IntegrityError("the recorded hybrid poses cannot be read", where=ref.original_name) from error
        if model.pose_covariance_frame == "scan":
            return {name: np.array(covariance) for name, covariance in model.pose_covariance.items()}
    return {}
