"""Computes the depth maps of pairs of images, each a task of the chosen executor."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from service.compute.camera_model import CameraModel
from service.compute.images.render import RayMesh
from service.compute.stereo.matching import DepthMap, depth_of_pair, guided_depth
from service.compute.stereo.rectify import StereoView, rectified
from service.core.geometry import Array, Transform
from service.machine.executors import mapping

Pair = tuple[int, int]


@dataclass(frozen=True, slots=True)
class StoredView:
    """A view whose image is in a file, so that it can travel."""

    file: Path
    camera: CameraModel
    T_world_camera: Transform

    def read(self) -> StereoView:
        """Return the view with its image."""
        return StereoView(np.load(self.file), self.camera, self.T_world_camera)


@dataclass(frozen=True, slots=True)
class _PairTask:
    """The task of matching two views of an object at `centre_m`; `near` is the file of a guessed surface, if any."""

    one: StoredView
    two: StoredView
    centre_m: Array
    near: Path | None


@contextmanager
def stored_views(views: Sequence[StereoView]) -> Generator[list[StoredView]]:
    """Provide the views with their images in temporary files."""
    with tempfile.TemporaryDirectory(prefix="orthocapture-stereo-") as scratch:
        stored: list[StoredView] = []
        for k, view in enumerate(views):
            stored.append(StoredView(Path(scratch) / f"{k}.npy", view.camera, view.T_world_camera))
            np.save(stored[-1].file, view.image)
        yield stored


def depth_maps(
    views: Sequence[StoredView],
    pairs: Sequence[Pair],
    centre_m: Array,
    report: Callable[[int], None],
    *,
    guess: RayMesh | None = None,
    processes: int = 1,
) -> list[DepthMap]:
    """Return the depth maps of those pairs that show the same, in their order.

    Args:
        views: the views.
        pairs: pairs of them by index.
        centre_m: (3,) the place of the object.
        report: a function that is called with the number of pairs matched.
        guess: the surface near which depth is searched; None: it is searched everywhere.
        processes: number of processes of this machine; 1: this one, unless a cluster was chosen.
    """
    with tempfile.TemporaryDirectory(prefix="orthocapture-stereo-") as scratch:
        near: Path | None = None
        if guess is not None:
            near = Path(scratch) / "guess"
            near.write_bytes(pickle.dumps(guess, protocol=pickle.HIGHEST_PROTOCOL))
        tasks = [_PairTask(views[one], views[two], centre_m, near) for one, two in pairs]
        found: list[DepthMap] = []
        report(0)
        with mapping(processes, len(tasks)) as map_over:
            for done, depth in enumerate(map_over(_depth_map, tasks), 1):
                found += [] if depth is None else [depth]
                report(done)
    _read_guess.cache_clear()
    return found


def _depth_map(task: _PairTask) -> DepthMap | None:
    one, two = task.one.read(), task.two.read()
    distance_m = float(np.linalg.norm(0.5 * (one.eye_m + two.eye_m) - task.centre_m))
    pair = rectified(one, two, task.centre_m)
    if task.near is None:
        return depth_of_pair(pair, distance_m)
    return guided_depth(pair, _read_guess(task.near), distance_m)


@lru_cache(maxsize=1)
def _read_guess(near: Path) -> RayMesh:
    """Return the surface of a file, whose path never recurs; it is held, so that its tree for rays is built once."""
    guess: RayMesh = pickle.loads(near.read_bytes())
    return guess
