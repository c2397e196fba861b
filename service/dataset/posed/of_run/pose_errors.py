"""The joint covariance of the poses of a data set, as far as the record of its run states it."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence

import numpy as np

from service.core.geometry import Array
from service.core.jobs.references import jobs_of
from service.dataset.summary import RunSummary
from service.jobs.registration import register
from service.jobs.registration.register import Registration


def own_pose_errors(summary: RunSummary, registered: Registration, names: Sequence[str]) -> Array | None:
    """(6 N, 6 N) joint covariance of T_scan_camera of these viewpoints, without the errors that are common to all.

    Stated for poses of structure from motion: the covariance of their bundle adjustment, after a similarity has
    aligned the positions with the true ones, in the scan's axes and in metres. The error of the scale is not in it,
    nor is that of the registration. None for poses of an arm, whose own errors the record does not state.

    Args:
        summary: the run.
        registered: one of its registrations.
        names: viewpoints, in the order of the rows.
    """
    tracks = _tracks(summary, registered)
    if tracks is None:
        return None
    with np.load(io.BytesIO(summary.store.artefact_path(tracks).read_bytes()), allow_pickle=False) as archive:
        order: list[str] = json.loads(str(archive["names"]))
        rows = (6 * np.array([order.index(name) for name in names])[:, None] + np.arange(6)).ravel()
        joint = np.asarray(archive["pose_covariance"], dtype=np.float64)[np.ix_(rows, rows)]
    R_scan_world = np.array(registered.T_world_scan)[:3, :3].T
    turned = np.zeros((6, 6))
    turned[:3, :3], turned[3:, 3:] = registered.scale * R_scan_world, R_scan_world
    J = np.kron(np.eye(len(names)), turned)
    return J @ joint @ J.T


def _tracks(summary: RunSummary, registered: Registration) -> str | None:
    """The file with the tracks from which the poses of a registration were adjusted."""
    for job in jobs_of(summary.state).values():
        if job.kind != register.KIND.name or job.status != "finished":
            continue
        tracks = job.arguments.get("tracks")
        if isinstance(tracks, str) and register.KIND.read_answer(job.result) == registered:
            return tracks
    return None
