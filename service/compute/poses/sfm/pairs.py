"""Which pairs of images are worth matching."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from service.compute.poses.sfm.options import SfmOptions
from service.core.geometry import Array, Transform

_ROWS = 2000  # rows of angles in memory at a time


def choose_pairs(
    names: Sequence[str],
    prior: Mapping[str, Transform] | None,
    neighbours: int,
    max_angle_deg: float,
    *,
    stations: Mapping[str, str] | None = None,
) -> list[tuple[int, int]]:
    """Index pairs worth matching: nearest viewing directions around the scene, in one connected graph.

    The scene centre is the point nearest to all optical axes. Images without a prior pose are paired with all.

    Args:
        names: of the images.
        prior: T_world_camera of images; None pairs all with all.
        neighbours: least number of images that each one is paired with.
        max_angle_deg: largest angle between the viewing directions of a pair.
        stations: frame of each image's prior pose, if there are several; all pairs across frames are kept, since
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
    """Pairs of names worth matching (see `choose_pairs`): a function only of the set of images and their poses.

    Before the images are taken, the planned poses give the pairs with which matching can begin; at the end, the pairs
    of the images that were taken are the ones used.
    """
    order = sorted(names)
    chosen = choose_pairs(order, T_world_camera_prior, options.neighbours, options.max_angle_deg, stations=stations)
    return [(order[i], order[j]) for i, j in chosen]


def _angles_deg(rays: Array, others: Array) -> Array:
    """(K, L) angles between unit vectors (K, 3) and (L, 3)."""
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
    """The nearest pairs between unconnected parts of the graph: several for each, since one may not match."""
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

    SciPy's would cost half a second of imports, and the state of a run is told with these pairs.
    """

    def __init__(self, nodes: int) -> None:
        self._towards = list(range(nodes))

    def of(self, node: int) -> int:
        """The node that stands for the part to which this one belongs."""
        towards = self._towards
        while towards[node] != node:
            towards[node] = node = towards[towards[node]]
        return node

    def join(self, one: int, other: int) -> None:
        """Add an edge."""
        self._towards[self.of(one)] = self.of(other)
