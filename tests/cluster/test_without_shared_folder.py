"""Workers of a cluster that see none of the job's folders: its files travel to them, and theirs come back.

The paths of the job begin with /proc/self/cwd: each process has a folder of its own there, and that of the workers is
another one than the job's.
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2
import psutil
import pytest

from service.computations.inputs import photographs_at
from service.computations.job import JobContext
from service.computations.kind import JobRecord
from service.computations.records import ImageFile
from service.compute.camera_model import CameraModel
from service.compute.images.render import RayMesh
from service.compute.sfm.front_end import FrontEnd
from service.compute.sfm.options import SfmOptions
from service.compute.stereo.matching import StereoView, looked_at_m, stereo_pairs
from service.compute.stereo.reconstruct import depth_maps, stored_views
from service.core.errors import DataError
from service.dataset.exporter import Progress, exporter, write_data_set
from service.machine.executors import mapping, noting_places
from service.machine.remote_task import WrittenFile, compute_there, remote_task
from service.store.store import Store
from tests.support.processes import cluster_tasks as tasks
from tests.support.processes.cluster import Cluster, bits, dask_cluster, end_tree, on, stopped
from tests.support.processes.forked import Forked
from tests.support.processes.waiting import until
from tests.support.record.store import start_run
from tests.support.scenes.posed import posed_data_set
from tests.support.scenes.slab_data_set import slab_mesh
from tests.support.scenes.textured_scene import camera_of_width, render, ring_of_poses, slabs

OWN = Path("/proc/self/cwd")


@pytest.fixture
def own(cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that the workers do not see, the folder for temporary files in it."""
    assert cluster.workers, "its processes have other folders than the one that follows"
    (tmp_path / "own" / "temporary").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "own")
    monkeypatch.setattr(tempfile, "tempdir", str(OWN / "temporary"))
    return OWN


def sent_to(cluster: Cluster) -> list[str]:
    """The names of the files that the workers have got."""
    return sorted(file.name for file in cluster.folder.rglob("sent/*/*"))


def test_a_file_that_changes_before_it_is_sent_is_refused_by_name(cluster: Cluster, own: Path) -> None:
    changed, gone = own / "changed", own / "gone"
    for file, change in ((changed, lambda: changed.write_bytes(b"again")), (gone, gone.unlink)):
        file.write_bytes(b"first")
        with on(cluster), mapping(1, 2) as map_over:
            with stopped(cluster):
                answers = map_over(tasks.read, [file, file])
                change()
            with pytest.raises(
                DataError, match=f"does not see the file {file}, and it cannot be sent there"
            ) as refused:
                list(answers)
        assert ("has changed since" in refused.value.what) == (file == changed)


def test_another_file_that_a_worker_has_under_the_path_is_not_taken_for_it(cluster: Cluster, own: Path) -> None:
    (own / "twin").write_bytes(b"ours")
    (cluster.folder / "twin").write_bytes(b"mine")
    with on(cluster), mapping(1, 2) as map_over:
        assert list(map_over(tasks.read, [own / "twin"] * 2)) == [b"ours"] * 2


def test_what_is_too_large_to_travel_is_refused_by_name(cluster: Cluster, own: Path) -> None:
    large = own / "large"
    with large.open("wb") as file:
        file.truncate(2_000_000_001)
    with on(cluster), mapping(1, 2) as map_over, pytest.raises(DataError, match="may have 2000 MB") as refused:
        list(map_over(tasks.read, [large, large]))
    assert str(large) in refused.value.where
    assert "Mount the data folder" in refused.value.remedy
    assert not sent_to(cluster)


def test_files_travel_once_a_worker_and_come_back(cluster: Cluster, own: Path) -> None:
    common, out = own / "common", own / "out"
    common.write_bytes(os.urandom(1_000_000))
    out.mkdir()
    (out / "earlier").touch()
    targets = [out / f"copy_{k}" for k in range(6)]
    (cluster.folder / "out").mkdir()  # the workers have a folder of their own under this path
    with on(cluster), noting_places() as places:
        with mapping(1, 6) as map_over:
            answers = list(map_over(tasks.copy_end, [(common, target) for target in targets]))
        assert 1 <= len(sent_to(cluster)) <= 2
        assert set(sent_to(cluster)) == {"common"}
        with mapping(1, 2) as map_over:
            sizes = list(map_over(tasks.extend, targets[:2]))
            with pytest.raises(DataError) as refused:
                list(map_over(tasks.refuse, targets[:2]))
    assert sum(places.values()) == 6 + 2
    assert answers == [(target, f"written: {target}", [target.name]) for target in targets]
    content = common.read_bytes()[-1000:]
    assert [target.read_bytes() for target in targets] == [content + b", more"] * 2 + [content] * 4
    assert sizes == [len(content) + 6] * 2
    assert refused.value.where == str(targets[0])
    assert refused.value.what == f"{targets[0]} has {sizes[0]} bytes"
    assert len(list(out.iterdir())) == 1 + len(targets)
    assert not list((cluster.folder / "out").iterdir())
    until(lambda: not sent_to(cluster), "the workers still have what was sent")


def test_what_a_task_writes_comes_back_from_any_executor_but_nothing_is_sent_to_it(tmp_path: Path) -> None:
    file, out = tmp_path / "file", tmp_path / "out"
    file.write_bytes(b"content")
    out.mkdir()
    task = remote_task(partial(tasks.copy_end, (file, out / "copy")))
    out.rename(tmp_path / "out, of another machine")
    out.mkdir()
    answer = compute_there(task)
    assert answer.value == (out / "copy", f"written: {out / 'copy'}", ["copy"])
    assert answer.written == (WrittenFile(str(out / "copy"), b"content"),)
    assert not list(out.iterdir())
    file.unlink()
    with pytest.raises(DataError, match="does not see the file"):
        compute_there(task)


@pytest.mark.slow
@pytest.mark.parametrize(
    "export_format", ["nerfstudio", *(pytest.param(name, marks=pytest.mark.sweep) for name in ("colmap", "hdf5"))]
)
def test_an_export_is_the_same_though_a_worker_is_killed(cluster: Cluster, own: Path, export_format: str) -> None:
    camera = CameraModel(320, 240, 380.0, 382.0, 156.0, 123.0, -0.12, 0.04, 8e-4, -5e-4)
    dataset = posed_data_set(own, 4, camera=camera)

    def export(name: str, progress: Progress | None = None) -> dict[str, bytes]:
        out = own / name
        write_data_set(dataset, exporter(export_format), out, processes=2, progress=progress)
        return {file.relative_to(out).as_posix(): file.read_bytes() for file in out.rglob("*") if file.is_file()}

    def kill_a_worker(_what: str, _done: int, _total: int) -> None:
        if not killed:
            killed.extend(psutil.Process(cluster.workers[0].pid).children()[:1])
            killed[0].kill()

    killed: list[psutil.Process] = []
    local = export("local")
    with on(cluster), noting_places() as places:
        assert export("cluster", kill_a_worker) == local
    assert sum(places.values()) == 4
    assert killed


@pytest.mark.slow
def test_features_of_reduced_copies_have_the_same_bits(cluster: Cluster, own: Path) -> None:
    full, small, scene = camera_of_width(640), camera_of_width(320), slabs()
    with Store.open(own / "data") as store:
        start_run(store)
        images: list[ImageFile] = []
        for k, T in enumerate(ring_of_poses(24)[:5]):
            file = own / f"view_{k}.png"
            assert cv2.imwrite(str(file), render(scene, full, T, k))
            ref = store.put_file(file, kind="image", media_type="image/png", original_name=file.name)
            images.append(ImageFile(viewpoint=file.stem, sha256=ref.sha256))

        def features(name: str) -> tuple[list[bytes], object]:
            scratch = own / name
            scratch.mkdir()
            context = JobContext(JobRecord(), store, scratch, lambda _what, _done, _total: None)
            copies = photographs_at(context, images, small, full)
            return [copy.read_bytes() for copy in copies], bits(front_end(copies, small))

        local = features("local")
        with on(cluster), noting_places() as places:
            assert features("cluster") == local
    assert sum(places.values()) == 2 * len(images) + 2
    assert len(set(local[0])) == len(images)


def front_end(files: Sequence[Path], camera: CameraModel) -> list[object]:
    """Features and matches of images, of which there are some."""
    named = {file.stem: file for file in files}
    pairs = [(a, b) for a in named for b in named if a < b]
    with FrontEnd(camera, SfmOptions(max_features=500), processes=2) as front:
        features = front.extract_all(named)
        stored = {name: files[0].with_name(f"{name}.npz") for name in named}
        for name, found in features.items():
            stored[name].write_bytes(found.to_bytes())
        matches = front.match_pairs(stored, pairs)
    assert sum(len(pair.features) for pair in matches) > 100, "there are matches to compare"
    return [features, matches]


@pytest.mark.slow
@pytest.mark.sweep
def test_so_have_depth_maps_of_pairs(cluster: Cluster, own: Path) -> None:
    assert own.is_dir()
    camera = dataclasses.replace(camera_of_width(320), k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0)
    views = [StereoView(render(slabs(), camera, T, 1), camera, T) for T in ring_of_poses(24)[:4]]
    guess, centre, pairs = slab_mesh(), looked_at_m(views), stereo_pairs(views)
    near = RayMesh(guess.vertices_m, guess.faces)

    def both() -> object:
        with stored_views(views) as stored:
            return bits(
                [depth_maps(stored, pairs, centre, lambda _done: None, guess=surface) for surface in (None, near)]
            )

    alone = both()
    with on(cluster), noting_places() as places:
        assert both() == alone
    assert sum(places.values()) == 2 * len(pairs)


@pytest.mark.slow
def test_a_scheduler_that_dies_leaves_files_and_folders_to_this_machine(
    own: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    common, out = own / "common", own / "out"
    common.write_bytes(os.urandom(1000) * 34_000)  # more than one piece
    out.mkdir()
    targets = [out / f"copy_{k}" for k in range(3)]
    with (
        dask_cluster(tmp_path, workers=1, nannies=False, start=Forked) as cluster,
        on(cluster),
        mapping(2, 3) as map_over,
    ):
        ((first, _, _),) = map_over(tasks.copy_end, [(common, out / "first")])
        assert first.read_bytes() == common.read_bytes()[-1000:]
        with stopped(cluster):
            answers = map_over(tasks.copy_end, [(common, target) for target in targets])
            end_tree(cluster.scheduler)
        assert [target for target, _, _ in answers] == targets
    assert [target.read_bytes() for target in targets] == [common.read_bytes()[-1000:]] * 3
    assert "3 tasks without an answer are computed on this machine" in caplog.text
