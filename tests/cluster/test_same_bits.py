"""What is parallel inside a job has the same bits in one process, in local ones and on a cluster, kind by kind.

A sweep over the kinds: that of the outlines, in test_cluster.py, always runs.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import psutil
import pytest

from service.compute.camera_model import CameraModel
from service.compute.images.render import RayMesh
from service.compute.sfm.front_end import FrontEnd
from service.compute.sfm.options import SfmOptions
from service.compute.stereo.matching import StereoView, looked_at_m, stereo_pairs
from service.compute.stereo.reconstruct import depth_maps, stored_views
from service.dataset.exporter import Progress, exporter, write_data_set
from service.machine.executors import noting_places
from tests.support.processes.cluster import Cluster, bits, on
from tests.support.scenes.posed import posed_data_set
from tests.support.scenes.slab_data_set import slab_mesh
from tests.support.scenes.textured_scene import camera_of_width, render, ring_of_poses, slabs


@pytest.mark.slow
@pytest.mark.sweep
def test_features_and_matches(cluster: Cluster, tmp_path: Path) -> None:
    camera, scene = camera_of_width(320), slabs()
    files = {f"view_{k}": tmp_path / f"view_{k}.png" for k in range(5)}
    for k, (file, T) in enumerate(zip(files.values(), ring_of_poses(24)[:5], strict=True)):
        assert cv2.imwrite(str(file), render(scene, camera, T, k))
    pairs = [(a, b) for a in files for b in files if a < b]
    stored = {name: tmp_path / f"{name}.npz" for name in files}

    def front_end(processes: int) -> object:
        with FrontEnd(camera, SfmOptions(max_features=500), processes=processes) as front:
            features = front.extract_all(files)
            for name, found in features.items():
                stored[name].write_bytes(found.to_bytes())
            matches = front.match_pairs(stored, pairs)
        assert sum(len(pair.features) for pair in matches) > 100, "there are matches to compare"
        return bits([features, matches])

    alone = front_end(1)
    assert front_end(2) == alone
    with on(cluster), noting_places() as places:
        assert front_end(1) == alone
    assert sum(places.values()) == 5 + 2


@pytest.mark.slow
@pytest.mark.sweep
def test_undistorted_pictures_and_depth_though_a_worker_is_killed(cluster: Cluster, tmp_path: Path) -> None:
    exports(cluster, tmp_path, "matching")


@pytest.mark.slow
@pytest.mark.sweep
def test_all_that_other_formats_are_made_from(cluster: Cluster, tmp_path: Path) -> None:
    exports(cluster, tmp_path, "hdf5")


def exports(cluster: Cluster, tmp_path: Path, export_format: str) -> None:
    camera = CameraModel(320, 240, 380.0, 382.0, 156.0, 123.0, -0.12, 0.04, 8e-4, -5e-4)
    dataset = posed_data_set(tmp_path, 4, camera=camera)

    def export(name: str, processes: int | None, progress: Progress | None = None) -> dict[str, bytes]:
        out = tmp_path / name
        write_data_set(dataset, exporter(export_format), out, processes=processes, progress=progress)
        return {file.relative_to(out).as_posix(): file.read_bytes() for file in out.rglob("*") if file.is_file()}

    def kill_a_worker(_what: str, _done: int, _total: int) -> None:
        if export_format == "matching" and not killed:
            killed.extend(psutil.Process(cluster.workers[0].pid).children()[:1])
            killed[0].kill()

    killed: list[psutil.Process] = []
    alone = export("alone", None)
    assert len(alone) > 4
    assert export("local", 2) == alone
    with on(cluster), noting_places() as places:
        assert export("cluster", 2, kill_a_worker) == alone
    assert sum(places.values()) == 4
    assert bool(killed) == (export_format == "matching")


@pytest.mark.slow
@pytest.mark.sweep
def test_depth_maps_of_pairs(cluster: Cluster) -> None:
    camera = dataclasses.replace(camera_of_width(320), k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0)
    views = [StereoView(render(slabs(), camera, T, 1), camera, T) for T in ring_of_poses(24)[:4]]
    guess, centre, pairs = slab_mesh(), looked_at_m(views), stereo_pairs(views)

    def both(processes: int) -> object:
        near = RayMesh(guess.vertices_m, guess.faces)
        with stored_views(views) as stored:
            maps = [
                depth_maps(stored, pairs, centre, lambda _done: None, guess=surface, processes=processes)
                for surface in (None, near)
            ]
        assert len(maps[0]) + len(maps[1]) > len(pairs), "there is depth to compare"
        return bits(maps)

    alone = both(1)
    assert both(2) == alone
    with on(cluster), noting_places() as places:
        assert both(1) == alone
    assert sum(places.values()) == 2 * len(pairs)
