"""What is parallel inside a job, on a Dask cluster of two workers: the same bits, and the job goes on without it."""

from __future__ import annotations

import dataclasses
import logging
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.compute.calibration.board import Board
from service.compute.calibration.board_search import find_boards
from service.compute.markers.image_files import detect_all, locate_outlines
from service.compute.scene import PosedImages, ScanSpheres
from service.core.errors import ComputeError, ConfigurationError, DataError
from service.core.records.run_events import JobFailed, JobFinished
from service.machine.executors import (
    VARIABLE,
    computing_as_environment_says,
    computing_at,
    mapping,
    noting_places,
)
from service.machine.remote_task import compute_there, remote_task
from service.machine.schedulers import GROUP, RemoteExecutors, Scheduler
from service.store.records import NewJob
from service.store.store import Store
from tests.support.boards.board_folder import board_folder
from tests.support.pages.certificates import self_signed
from tests.support.processes import cluster_tasks as tasks
from tests.support.processes.cluster import Cluster, bits, dask_cluster, end_tree, on
from tests.support.processes.forked import Forked
from tests.support.processes.forked import run as run_command
from tests.support.processes.waiting import until
from tests.support.record.store import enqueue, start_run
from tests.support.rig.rig import REPOSITORY, command
from tests.support.scenes.sphere_images import CONTROL_M, RADIUS_M, REGISTRATION_M, render, scene

EVERYTHING = np.vstack([REGISTRATION_M, CONTROL_M])
WITHOUT_DASK = """
import sys
sys.modules["distributed"] = None
from service.cli.main import main
sys.argv = ["orthocapture", *sys.argv[1:]]
main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("found_by", ["locate", pytest.param("detect", marks=pytest.mark.sweep)])
def test_outlines_have_the_same_bits_in_one_process_in_local_ones_and_on_a_cluster(
    cluster: Cluster, tmp_path: Path, found_by: str
) -> None:
    made = scene(3, 400, seed=21)
    files = [tmp_path / f"view_{i}.jpg" for i in range(3)]
    for i, file in enumerate(files):
        assert cv2.imwrite(str(file), render(made.camera, made.centres_camera(i, EVERYTHING), i, oversample=2))
    posed = PosedImages(made.T_world_camera, made.camera)
    spheres = ScanSpheres(REGISTRATION_M, RADIUS_M, control_m=CONTROL_M)

    def outlines(workers: int) -> object:
        if found_by == "detect":
            return bits(detect_all(files, made.camera, workers=workers))
        return bits(locate_outlines(files, posed, spheres, workers=workers))

    alone = outlines(1)
    assert len(str(alone)) > 2000, "there are outlines to compare"
    assert outlines(2) == alone
    with on(cluster), noting_places() as places:
        assert outlines(2) == alone
    assert sum(places.values()) >= len(files)
    assert all(place.host and place.processor for place in places)


@pytest.mark.slow
@pytest.mark.sweep
def test_the_corners_of_a_board_have_the_same_bits_too(cluster: Cluster, tmp_path: Path) -> None:
    board = Board(7, 5, 0.02)
    folder = board_folder(tmp_path, board, count=3).images
    files = sorted(folder.iterdir()) * 8  # so many that processes are worth it
    alone = bits(find_boards(files, board))
    assert "BoardView" in str(alone)
    assert bits(find_boards(files, board, workers=2)) == alone
    with on(cluster), noting_places() as places:
        assert bits(find_boards(files, board, workers=2)) == alone
    assert sum(places.values()) == len(files)


def test_a_file_that_has_changed_under_its_path_is_read_again(cluster: Cluster, tmp_path: Path) -> None:
    files = [tmp_path / "one", tmp_path / "two"]
    with on(cluster):
        for content in (b"first", b"again"):
            for file in files:
                file.write_bytes(content)
            with mapping(2, 2) as map_over:
                assert list(map_over(tasks.read, files)) == [content, content]


def test_a_worker_that_is_killed_costs_its_task_alone(cluster: Cluster, tmp_path: Path) -> None:
    with on(cluster), mapping(2, 12) as map_over:
        assert list(map_over(tasks.kill_once, [(number, tmp_path) for number in range(12)])) == list(range(12))
    assert (tmp_path / "killed").exists()


@pytest.mark.slow
def test_a_task_that_kills_workers_fails_with_the_reason(cluster: Cluster) -> None:
    with on(cluster):
        with (
            pytest.raises(ComputeError, match="a task has killed every worker that computed it"),
            mapping(2, 2) as map_over,
        ):
            list(map_over(tasks.kill_worker, [1, 2]))
        with mapping(2, 4) as map_over:
            assert list(map_over(tasks.square, range(4))) == [0, 1, 4, 9], "the cluster can still be used"


@contextmanager
def half_done(folder: Path, patience_s: float) -> Generator[tuple[Cluster, list[int]]]:
    """Have six tasks on a cluster, of which some have begun there; afterwards they are let go, wherever they are."""
    begun, gate = folder / "begun", folder / "gate"
    begun.mkdir()
    with dask_cluster(folder, nannies=False, start=Forked) as cluster:
        assert not refusal_of(Scheduler(cluster.address, patience_s=90.0)), "its workers are there"
        with on(cluster, patience_s), mapping(2, 6) as map_over:
            results = iter(map_over(tasks.wait_for, [(number, begun, gate) for number in range(6)]))
            found: list[int] = []
            try:
                until(lambda: len(list(begun.iterdir())) >= 2, "no task has begun on the cluster")
                there = _processes(begun)
                yield cluster, found
                until(lambda: bool(_processes(begun) - there), "nothing was taken over")
            finally:
                gate.touch()
            found += results


def _processes(begun: Path) -> set[str]:
    return {file.name.partition("-")[2] for file in begun.iterdir()}


@pytest.mark.slow
def test_a_scheduler_that_dies_leaves_the_job_to_this_machine(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with half_done(tmp_path, 60.0) as (cluster, found):
        end_tree(cluster.scheduler)
    assert found == list(range(6))
    assert "the cluster is lost" in caplog.text
    assert "6 tasks without an answer are computed on this machine" in caplog.text


@pytest.mark.slow
@pytest.mark.realtime
def test_so_does_one_that_does_not_answer_any_more(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with half_done(tmp_path, 5.0) as (cluster, found):
        os.kill(cluster.scheduler.pid, signal.SIGSTOP)
    assert found == list(range(6))
    assert "has not answered for 5 s" in caplog.text


@pytest.mark.slow
@pytest.mark.realtime
def test_so_does_one_without_workers(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with half_done(tmp_path, 5.0) as (cluster, found):
        for worker in cluster.workers:
            end_tree(worker)
    assert found == list(range(6))
    assert "has had no worker for 5 s" in caplog.text


@pytest.mark.slow
@pytest.mark.realtime
def test_a_cluster_without_workers_is_refused_at_the_start_and_does_not_hold_up_a_job(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with dask_cluster(tmp_path, workers=0, start=Forked) as cluster:
        with pytest.raises(ConfigurationError, match="has had no worker for 2 s"):
            RemoteExecutors(Scheduler(cluster.address, patience_s=2.0)).connect()
        with on(cluster, 2.0), caplog.at_level(logging.WARNING), mapping(2, 2) as map_over:
            assert list(map_over(tasks.square, [2, 3])) == [4, 9]
    assert "this machine computes alone" in caplog.text


@pytest.mark.slow
def test_a_worker_with_another_source_is_refused_by_name(tmp_path: Path) -> None:
    other = tmp_path / "other"
    skipped = shutil.ignore_patterns("__pycache__", "migrations", "templates", "static")
    for package in ("service", "drivers"):
        shutil.copytree(REPOSITORY / package, other / package, ignore=skipped)
    with (other / "service/core/units.py").open("a", encoding="utf-8") as file:
        file.write("\nMORE = 1\n")
    with dask_cluster(tmp_path, workers=1, nannies=False, start=Forked) as cluster:
        cluster.start = subprocess.Popen  # a fork has the modules of this source
        cluster.add_worker({"PYTHONPATH": str(other)}, "--no-nanny")

        last: list[str] = []

        def refused() -> bool:
            last.append(refusal_of(Scheduler(cluster.address)))
            return bool(last[-1])

        until(refused, lambda: (tmp_path / "worker1.log").read_text(encoding="utf-8"))
    assert "has orthocapture 0.1.0, source" in last[-1]
    assert "Install the same version of orthocapture there" in last[-1]


def refusal_of(scheduler: Scheduler) -> str:
    """Why a cluster is refused; "" if it is not."""
    executors = RemoteExecutors(scheduler)
    try:
        executors.connect()
    except ConfigurationError as error:
        return str(error)
    executors.close()
    return ""


def test_a_cluster_is_reached_by_tls_with_the_files_of_its_authority(tmp_path: Path) -> None:
    certificate, key = self_signed(tmp_path)
    options = ("--tls-ca-file", str(certificate), "--tls-cert", str(certificate), "--tls-key", str(key))
    with dask_cluster(tmp_path, workers=1, nannies=False, options=options, scheme="tls", start=Forked) as cluster:
        assert cluster.address.startswith("tls://")
        with computing_at(Scheduler(cluster.address, certificate, certificate, key)), mapping(2, 2) as map_over:
            assert list(map_over(tasks.square, [2, 3])) == [4, 9]
        (tmp_path / "stranger").mkdir()
        stranger, its_key = self_signed(tmp_path / "stranger")
        with pytest.raises(ConfigurationError, match="no scheduler answers"):
            RemoteExecutors(Scheduler(cluster.address, stranger, stranger, its_key, patience_s=5.0)).connect()


@pytest.mark.slow
def test_a_worker_of_a_cluster_records_the_processors_that_computed_an_answer(
    cluster: Cluster, tmp_path: Path
) -> None:
    made = scene(3, 480, seed=21)
    data = tmp_path / "data"
    with Store.open(data) as store:
        run = start_run(store)
        images: list[dict[str, object]] = []
        for i in range(3):
            file = tmp_path / f"view_{i}.png"
            assert cv2.imwrite(str(file), render(made.camera, made.centres_camera(i, EVERYTHING), i, oversample=2))
            ref = store.put_file(file, kind="image", media_type="image/png", original_name=file.name)
            pose = made.T_world_camera[i].tolist()
            images.append({"viewpoint": file.stem, "sha256": ref.sha256, "T_scene_camera": pose})
        arguments = {
            "images": images,
            "camera": dataclasses.asdict(made.camera),
            "spheres_m": REGISTRATION_M.tolist(),
            "sphere_covariance_m2": [(1e-10 * np.eye(3)).tolist()] * len(REGISTRATION_M),
            "radius_m": RADIUS_M,
        }
        enqueue(store, run, NewJob("detect_spheres", "registration", 1, "outlines", arguments), actor="runner")
    options = command("worker", "--data", str(data), "--until-idle", "--json", "--scheduler", cluster.address)
    ended = run_command(options, cwd=REPOSITORY, timeout_s=120)
    assert ended.returncode == 0, ended.stderr
    with Store.open(data) as store:
        (end,) = [event.payload for event in store.events(run) if isinstance(event.payload, (JobFinished, JobFailed))]
    assert isinstance(end, JobFinished), end
    assert end.computed_on is not None
    assert end.computed_on.processor
    (host,) = end.computed_on.cluster
    assert (host.host, host.processor) == (os.uname().nodename, end.computed_on.processor)
    assert host.tasks >= 3
    old = {name: value for name, value in end.model_dump(mode="json").items() if name != "computed_on"}
    assert JobFinished.model_validate(old).computed_on is None, "as earlier versions wrote it"


def test_a_file_that_another_machine_does_not_see_is_named_with_the_machine(tmp_path: Path) -> None:
    file = tmp_path / "photograph.jpg"
    file.write_bytes(b"photograph")
    task = remote_task(partial(tasks.read, file))
    assert compute_there(task).value == b"photograph"
    file.write_bytes(b"another one")
    with pytest.raises(DataError, match="sees another file under the path"):
        compute_there(task)
    file.unlink()
    with pytest.raises(DataError, match="does not see the file") as refused:
        compute_there(task)
    assert refused.value.where == f"{os.uname().nodename}:{file}"


def test_other_versions_are_refused_by_the_task_too() -> None:
    task = dataclasses.replace(remote_task(partial(tasks.square, 3)), versions=(("numpy", "1.0"),))
    with pytest.raises(ConfigurationError, match=r"numpy 2\S+ instead of 1.0"):
        compute_there(task)


def test_arrays_do_not_travel() -> None:
    with pytest.raises(ConfigurationError, match=r"the arguments of one task have 8\.0 MB"):
        remote_task(partial(len, np.zeros(1_000_000)))


def test_any_executor_can_be_plugged_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "thread_executor.py").write_text(
        "from concurrent.futures import ThreadPoolExecutor\n"
        "def opened(scheduler):\n"
        "    return ThreadPoolExecutor(int(scheduler.address.partition('://')[2]))\n",
        encoding="utf-8",
    )
    about = tmp_path / "thread_executor-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: thread-executor\nVersion: 1.0\n", encoding="utf-8")
    (about / "entry_points.txt").write_text(f"[{GROUP}]\nthreads = thread_executor:opened\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    with computing_at(Scheduler("threads://3")), noting_places() as places, mapping(1, 5) as map_over:
        assert list(map_over(tasks.square, range(5))) == [0, 1, 4, 9, 16]
    assert sum(places.values()) == 5
    for address, elsewhere in (("threads://2", 4), ("", 0)):
        monkeypatch.setenv(VARIABLE, address)
        with computing_as_environment_says(), noting_places() as places, mapping(1, 4) as map_over:
            assert list(map_over(tasks.square, range(4))) == [0, 1, 4, 9]
        assert sum(places.values()) == elsewhere


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--scheduler", "head:8786"], "the address of the scheduler is of no known kind"),
        (["--scheduler", "tls://head:8786"], "a scheduler reached by tls needs three files"),
        (
            ["--scheduler", "tcp://head:1", "--scheduler-ca", "ca.pem"],
            "the address says tcp, which is not encrypted",
        ),
        (["--scheduler-ca", "ca.pem"], "files for a scheduler are given, but no --scheduler"),
    ],
)
def test_options_that_contradict_each_other_are_refused(tmp_path: Path, options: list[str], why: str) -> None:
    ended = run_command(command("worker", "--data", str(tmp_path), "--until-idle", *options), timeout_s=120)
    assert ended.returncode == 1, ended.stderr
    assert why in " ".join((ended.stdout + ended.stderr).split())


def test_without_its_package_the_option_is_refused_by_name(tmp_path: Path) -> None:
    options = ("worker", "--data", str(tmp_path), "--until-idle", "--scheduler", "tcp://127.0.0.1:9")
    wide = {**os.environ, "COLUMNS": "400"}
    ended = subprocess.run(
        [sys.executable, "-c", WITHOUT_DASK, *options],
        cwd=REPOSITORY, env=wide, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ended.returncode == 1, ended.stderr
    said = ended.stdout + ended.stderr
    assert "needs the package distributed, which is not installed" in said
    assert 'pip install "orthocapture[cluster]"' in said
