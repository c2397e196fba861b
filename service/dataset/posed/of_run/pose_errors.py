"""The joint covariance of the poses of a data set, as far as the record of its run states it."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence

import numpy as np

from service.core.geometry import Array
from service.core.jobs import jobs_of
from service.core.run.state import JobState
from service.dataset.summary import RunSummary
from service.jobs.registration import register
from service.jobs.registration.register import Registration


def own_pose_errors(summary: RunSummary, registered: Registration, names: Sequence[str]) -> Array | None:
    """(6 N, 6 N) joint covariance of T_scan_camera of these viewpoints, without the errors that are common to all.

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
    """(6 N, 6 N) joint covariance of T_scan_camera of these viewpoints, with that of the registration.

    Stated for poses of an arm and of the spheres. None for other poses, and in runs of earlier versions.

    Args:
        summary: the run.
        registered: one of its registrations.
        names: viewpoints, in the order of the rows.
    """
    made = _job(summary, registered)
    kept = [ref for ref in made.artefacts if ref.kind == register.POSE_ERRORS] if made is not None else []
    return _joint(summary, kept[0].sha256, "covariance", names) if kept else None


def _joint(summary: RunSummary, sha256: str, array: str, names: Sequence[str]) -> Array:
    """(6 N, 6 N) of these viewpoints, from a file that has their names beside the array."""
    with np.load(io.BytesIO(summary.store.artefact_path(sha256).read_bytes()), allow_pickle=False) as archive:
        order: list[str] = json.loads(str(archive["names"]))
        rows = (6 * np.array([order.index(name) for name in names])[:, None] + np.arange(6)).ravel()
        return np.asarray(archive[array], dtype=np.float64)[np.ix_(rows, rows)]


def _tracks(summary: RunSummary, registered: Registration) -> str | None:
    """The file with the tracks from which the poses of a registration were adjusted."""
    made = _job(summary, registered)
    tracks = None if made is None else made.arguments.get("tracks")
    return tracks if isinstance(tracks, str) else None


def _job(summary: RunSummary, registered: Registration) -> JobState | None:
    """The job that computed a registration."""
    finished = (job for job in jobs_of(summary.state).values() if job.status == "finished")
    made = (job for job in finished if job.kind == register.KIND.name)
    return next((job for job in made if register.KIND.read_answer(job.result) == registered), None)
