"""Holds the settings of structure from motion, and chooses which pairs of images are worth matching."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from service.compute.camera_model import CameraModel
from service.core.geometry import Array, Transform

Mapper = Literal["incremental", "global", "triangulated"]
Refine = Literal["nothing", "principal_point", "intrinsics"]
Progress = Callable[[str, int, int], None]  # stage, done, total (total 0: unknown)


@dataclass(frozen=True, slots=True)
class SfmOptions:
    """Settings of the front end and of the refinement.

    Attributes:
        max_image_size: longer side to which images are reduced for feature extraction; 0 keeps the full size.
        max_features: most per image; most of them are those with the smallest scales (`extract_sift`).
        first_octave: -1 doubles the image first (finer and four times slower), 0 does not.
        neighbours: number of images, nearest in viewing direction, with which each image is matched (needs a prior).
        max_angle_deg: largest angle between two matched views, as seen from the scene.
        verification_error_px: largest epipolar distance of an inlier match, at extraction size.
        filter_error_px: observations with larger errors are dropped before the final bundle adjustment.
        min_track: least number of views of a point in the final bundle adjustment.
        loss_px: scale of the final bundle adjustment's robust (Cauchy) loss.
        threads: number of threads of extraction and matching.
        mapping_threads: number of threads of mapping and bundle adjustment. With one, the same features give the same
            model bit for bit; with more, sums depend on the order in which threads finish.
        refine: intrinsics that the final bundle adjustment may change.
        seed: seed of all random choices.
        timeout_s: time limit of one stage.
    """

    max_image_size: int = 3200
    max_features: int = 3000
    first_octave: int = 0
    neighbours: int = 8
    max_angle_deg: float = 60.0
    verification_error_px: float = 2.0
    filter_error_px: float = 1.5
    min_track: int = 3
    loss_px: float = 0.5
    threads: int = 2
    mapping_threads: int = 1
    refine: Refine = "nothing"
    seed: int = 1
    timeout_s: float = 3600.0


Effort = Literal["quick", "normal", "quality"]


def options_for(effort: Effort, camera: CameraModel, *, refine: Refine = "nothing", threads: int = 2) -> SfmOptions:
    """Return the settings for images of this camera.

    Camera positions were off by 0.017–0.028 mm (normal) and 0.013 mm (quality) on 20 rendered images 1920 px wide of
    a scene 0.65 m away (bench/poses/sfm.py); the errors are noise, so more features reduce them.
    """
    longer = max(camera.width, camera.height)
    if effort == "quick":
        return SfmOptions(max_image_size=1280, max_features=2500, neighbours=8, refine=refine, threads=threads)
    if effort == "normal":
        return SfmOptions(
            max_image_size=min(longer, 2400), max_features=4000, neighbours=8, refine=refine, threads=threads
        )
    # Small images are doubled first; large ones have enough pixels.
    small = longer <= 2400
    return SfmOptions(
        max_image_size=min(longer, 4000),
        max_features=8000,
        first_octave=-1 if small else 0,
        neighbours=10,
        refine=refine,
        threads=threads,
    )


def reduction(max_image_size: int, width: int, height: int) -> float:
    """Return the image pixels per pixel at which features are extracted."""
    return max(1.0, max(width, height) / max_image_size) if max_image_size else 1.0


_ROWS = 2000  # rows of angles in memory at a time


def choose_pairs(
    names: Sequence[str],
    prior: Mapping[str, Transform] | None,
    neighbours: int,
    max_angle_deg: float,
    *,
    stations: Mapping[str, str] | None = None,
) -> list[tuple[int, int]]:
    """Choose index pairs worth matching: nearest viewing directions around the scene, in one connected graph.

    The scene centre is the point nearest to all optical axes. Images without a prior pose are paired with all.

    Args:
        names: names of the images.
        prior: T_world_camera of images; None pairs all with all.
        neighbours: least number of images that each one is paired with.
        max_angle_deg: largest angle between the viewing directions of a pair.
        stations: frame of each image's prior pose, if there are several; all pairs across frames are chosen, since
            nothing is known about them.
    """
    if stations is not None and len({stations.get(name) for name in names}) > 1:
        return _by_station(names, prior, neighbours, max_angle_deg, stations)
    n = len(names)
    known = [k for k, name in enumerate(names) if prior is not None and name in prior]
    if prior is None or len(known) < 3:
        return [(i, j) for i in range(n) for j in range(i + 1, n)]
    poses = np.stack([prior[names[k]] for k in known])
    axes, centres = poses[:, :3, 2], poses[:, :3, 3]
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    scene = np.linalg.lstsq(projectors.sum(axis=0), np.einsum("nij,nj->i", projectors, centres), rcond=None)[0]
    rays = centres - scene
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    unknown = set(range(n)).difference(known)
    chosen = {_ordered(k, other) for k in unknown for other in range(n) if other != k}
    for first in range(0, len(known), _ROWS):
        angle = _angles_deg(rays[first : first + _ROWS], rays)
        for row, to_others in enumerate(angle, start=first):
            to_others[row] = np.inf
            for column in np.argsort(to_others)[:neighbours]:
                if to_others[column] <= max_angle_deg:
                    chosen.add(_ordered(known[row], known[int(column)]))
    return sorted(chosen | _bridges(chosen, known, rays, n))


def pairs_of(
    names: Iterable[str],
    T_world_camera_prior: Mapping[str, Transform] | None,
    options: SfmOptions,
    *,
    stations: Mapping[str, str] | None = None,
) -> list[tuple[str, str]]:
    """Return pairs of names worth matching (see `choose_pairs`); they depend only on the set of images and poses.

    Before the images are taken, the planned poses give the pairs with which matching can start; at the end, the pairs
    of the images that were taken are the ones used.
    """
    order = sorted(names)
    chosen = choose_pairs(order, T_world_camera_prior, options.neighbours, options.max_angle_deg, stations=stations)
    return [(order[i], order[j]) for i, j in chosen]


def _angles_deg(rays: Array, others: Array) -> Array:
    """Return (K, L) angles between unit vectors (K, 3) and (L, 3)."""
    return np.degrees(np.arccos(np.clip(rays @ others.T, -1, 1)))


def _by_station(
    names: Sequence[str],
    prior: Mapping[str, Transform] | None,
    neighbours: int,
    max_angle_deg: float,
    stations: Mapping[str, str],
) -> list[tuple[int, int]]:
    n = len(names)
    own = [stations.get(name) for name in names]
    chosen = {(i, j) for i in range(n) for j in range(i + 1, n) if own[i] != own[j]}
    for station in set(own):
        mine = [k for k in range(n) if own[k] == station]
        inner = choose_pairs([names[k] for k in mine], prior, neighbours, max_angle_deg)
        chosen |= {(mine[i], mine[j]) for i, j in inner}
    return sorted(chosen)


def _ordered(i: int, j: int) -> tuple[int, int]:
    return (i, j) if i < j else (j, i)


def _bridges(chosen: set[tuple[int, int]], known: list[int], rays: Array, n: int) -> set[tuple[int, int]]:
    """Return the nearest pairs between unconnected parts of the graph: several for each, since one may not match."""
    parts = _Parts(n)
    for i, j in chosen:
        parts.join(i, j)
    added: set[tuple[int, int]] = set()
    while True:
        label = np.array([parts.of(k) for k in known])
        inside = label == label[0]
        rows, columns = np.flatnonzero(inside), np.flatnonzero(~inside)
        if len(columns) == 0:
            return added
        if len(rays) <= _ROWS:  # bit-identical to the choice above: of equal angles, the first counts
            block = _angles_deg(rays, rays)[np.ix_(rows, columns)]
        else:
            block = _angles_deg(rays[rows], rays[columns])
        for flat in np.argsort(block, axis=None)[:6]:
            r, c = divmod(int(flat), len(columns))
            pair = _ordered(known[int(rows[r])], known[int(columns[c])])
            added.add(pair)
            parts.join(*pair)


class _Parts:
    """The connected parts of a graph that only gains edges.

    SciPy's would cost half a second of imports, and the state of a run is reported with these pairs.
    """

    def __init__(self, nodes: int) -> None:
        self._towards = list(range(nodes))

    def of(self, node: int) -> int:
        """Return the node that stands for the part to which this one belongs."""
        towards = self._towards
        while towards[node] != node:
            towards[node] = node = towards[towards[node]]
        return node

    def join(self, one: int, other: int) -> None:
        """Add an edge."""
        self._towards[self.of(one)] = self.of(other)
