"""The state from which a registration begins: bases and scale from the poses of single images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from service.compute.registration.identification.identity import Assignment
from service.compute.registration.least_squares.problem import Problem, State
from service.compute.scene import PosedImages
from service.core.errors import ComputeError
from service.core.geometry import Array, Transform, apply, transform


def starting_state(problem: Problem, assignments: Sequence[Assignment], images: PosedImages) -> State:
    """Initial bases and scale from the assignments' poses: the mean of the half of each station's images that agree.

    Raises:
        ComputeError: a station has no image with a pose, or the poses do not determine the scale.
    """
    poses, groups = images.poses, images.stations
    scale = 1.0
    if problem.with_scale:
        scales = [a.scale for a in assignments if a.scale is not None]
        scale = float(np.median(scales)) if scales else _scale(problem, assignments, poses, groups)
    bases: list[Transform] = []
    for g in problem.groups:
        candidates: list[Transform] = []
        for i, a in enumerate(assignments):
            if int(groups[i]) == g and a.T_camera_scan is not None:
                T = np.array(poses[i], dtype=np.float64)
                T[:3, 3] *= scale
                candidates.append(T @ a.T_camera_scan)
        if not candidates:
            raise ComputeError(f"no image of station {g} has a starting pose", where=f"station {g}")
        middle = problem.centres.mean(axis=0)
        places = np.array([apply(T, middle) for T in candidates])
        far = np.linalg.norm(places - np.median(places, axis=0), axis=1)
        near = np.argsort(far)[: max(1, (len(far) + 1) // 2)]
        R = Rotation.from_matrix(np.array([candidates[k][:3, :3] for k in near])).mean()
        bases.append(transform(R, places[near].mean(axis=0) - R.apply(middle)))
    n = problem.n_images
    return State(
        np.array(bases),
        scale,
        np.zeros_like(problem.centres),
        np.zeros(problem.size - problem.common_column),
        np.zeros((n, 6)),
    )


def _scale(problem: Problem, assignments: Sequence[Assignment], poses: Array, groups: NDArray[np.int64]) -> float:
    """Initial scale from the assignments' poses: R_i c_i + scale p_i (positions p_i) is equal for all i."""
    middle = problem.centres.mean(axis=0)
    upper, lower = 0.0, 0.0
    for g in problem.groups:
        mine = {
            i: poses[i][:3, :3] @ apply(a.T_camera_scan, middle)
            for i, a in enumerate(assignments)
            if int(groups[i]) == g and a.T_camera_scan is not None
        }
        if len(mine) < 2:
            continue
        seen = np.array(list(mine.values()))
        position = poses[list(mine), :3, 3] - poses[list(mine), :3, 3].mean(axis=0)
        upper -= float(np.sum(position * (seen - seen.mean(axis=0))))
        lower += float(np.sum(position**2))
    if upper <= 0.0 or lower <= 0.0:
        raise ComputeError(
            "the scale of the camera positions cannot be determined from the images alone",
            remedy="Use poses of several images of the same scene, from different places",
        )
    return upper / lower
