"""The benchmark of a recorded run as a job: who takes it, what is recorded, and what the command computes."""

from __future__ import annotations

import json
import os
import sys
import threading
from pathlib import Path

import psutil
import pytest
from typer.testing import CliRunner

from service.audit.recorded_run import read_run
from service.audit.replay import DEFAULT_KINDS, JobReplay, replay
from service.cli.main import app
from service.core.records.run_events import JobEnqueued, JobFailed, JobFinished, RunCompleted
from service.monitor.snapshot import living_workers
from service.store.durable_effects import SystemClock
from service.store.store import Store
from service.store.verification.verify import verify
from service.web.dataset import benchmark_of
from service.worker.loop import work
from tests.support.processes.forked import Forked
from tests.support.processes.method_plugin import AT_RANDOM, ENDLESS, TRUTH
from tests.support.processes.waiting import until
from tests.support.record.grants import write_grant
from tests.support.recorded.benchmarked_run import ASKED, METHOD, BenchmarkedRun, unpack_benchmarked_run
from tests.support.rig.rig import REPOSITORY


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> BenchmarkedRun:
    return unpack_benchmarked_run(tmp_path_factory.mktemp("site"))


@pytest.fixture(scope="module")
def answers(site: BenchmarkedRun) -> tuple[JobFinished, JobFinished]:
    """The answers to two benchmarks that two workers without the method have left to a third one.

    The second is of a method that makes another mesh each time.
    """
    asked = site.ask(), site.ask(method=AT_RANDOM)
    again = site.ask()
    assert again == asked[0], "the same that waits is not enqueued twice"
    assert site.worker(method=False) == 0
    assert site.worker(method=True, truth=False) == 0
    assert site.worker(method=True, scheduler="tcp://nowhere:1") == 2
    first, second = (site.event(JobFinished, job["job"])[1] for job in asked)
    return first, second


@pytest.fixture(scope="module")
def answer(answers: tuple[JobFinished, JobFinished]) -> JobFinished:
    return answers[0]


@pytest.mark.slow
def test_the_machine_with_the_method_answers_and_the_answer_is_evidence(
    site: BenchmarkedRun, answer: JobFinished
) -> None:
    result = answer.result
    assert (result["method"], result["version"], result["views"], result["width"]) == (METHOD, "1.2", 5, 200)
    assert result["effort"]["wall_s"] > 0
    assert result["machine"]["cores"] > 0
    assert answer.measures["chamfer_mm"] == result["score"]["chamfer_mm"] > 0
    kinds = {ref.kind: ref for ref in answer.artefacts}
    assert set(kinds) == {"benchmark_mesh", "benchmark_scored_mesh", "benchmark_heat_maps"}
    assert kinds["benchmark_mesh"].sha256 == result["mesh_sha256"]
    asked, _ = site.event(JobEnqueued, answer.job)
    assert asked.actor == "Erika"
    run = read_run(site.data, "latest")
    (completed,) = [event for event in run.events if isinstance(event.payload, RunCompleted)]
    assert asked.seq > completed.seq
    assert run.state.status == "completed"
    assert verify(site.data).ok
    shown = benchmark_of(site.data, run.events)  # what the page of the data set shows
    assert [result.method for result in shown.results] == [AT_RANDOM, METHOD]
    with Store.open(site.data) as store:  # each of both was signed, although nobody drives the run
        assert store.checkpoints(run.run_id)[-1].seq == run.events[-1].seq


@pytest.mark.slow
def test_a_replay_compares_the_mesh_or_says_why_not(
    site: BenchmarkedRun, answers: tuple[JobFinished, JobFinished]
) -> None:
    def replayed(*, truth: bool) -> list[JobReplay]:
        with site.machine(method=True, truth=truth):
            report = replay(read_run(site.data, "latest"), kinds=["benchmark"], progress=lambda *_: None)
        by_id = {job.job: job for job in report.jobs}
        return [by_id[answer.job] for answer in answers]

    assert "benchmark" not in DEFAULT_KINDS
    same, random = replayed(truth=True)
    assert (same.verdict, same.differences) == ("identical", ())
    assert random.verdict == "not_replayed"
    assert random.error == f"{AT_RANDOM} makes another mesh each time, so that there is nothing to compare"
    lacking, _ = replayed(truth=False)
    assert lacking.verdict == "not_replayed"
    assert "Shifted truth cannot run here: SHIFTED_TRUTH names no file" in lacking.error


@pytest.mark.slow
def test_an_exported_folder_has_the_same_score(site: BenchmarkedRun, answer: JobFinished, tmp_path: Path) -> None:
    with site.machine(method=True):
        status, printed = site.call("export", "latest", "--format", "hdf5", "--out", str(tmp_path / "dataset"))
        assert status == 0, printed
        command = ["benchmark", "run", str(tmp_path / "dataset"), "--method", METHOD, *ASKED]
        status, printed = site.call(*command, "--out", str(tmp_path / "out"))
    assert status == 0, printed
    assert printed["score"] == answer.result["score"]
    # The mesh's header has the hash of the images that the method was given, and no cluster.
    assert printed["mesh_sha256"] == answer.result["mesh_sha256"]


@pytest.mark.slow
def test_the_command_waits_for_the_answer_and_writes_it_as_that_of_a_folder(
    site: BenchmarkedRun, answer: JobFinished, tmp_path: Path
) -> None:
    ended = threading.Event()

    def serve() -> None:
        with Store.open(site.data) as store:
            work(store, until_idle=False, stop=ended.is_set, progress=lambda *_: None)

    out = tmp_path / "out"
    with site.machine(method=True):
        worker = threading.Thread(target=serve)
        worker.start()
        try:
            command = ["benchmark", "run", "latest", "--method", METHOD, *ASKED, "--out", str(out)]
            done = CliRunner().invoke(app, [*command, "--data", str(site.data)], catch_exceptions=False)
        finally:
            ended.set()
            worker.join()
        assert done.exit_code == 0, done.output
        assert "Shifted truth, sparse, 5 images: Chamfer distance" in done.stdout
        assert "worker" in done.stderr
        command = ["benchmark", "table", "--out", str(out), "--figure", str(tmp_path / "figure.png"), "--json"]
        table = CliRunner().invoke(app, command, catch_exceptions=False)
    (result,) = json.loads(table.stdout)["results"]
    assert result["score"] == answer.result["score"]
    assert (tmp_path / "figure.png").stat().st_size > 1000


@pytest.mark.slow
def test_a_method_that_is_gone_fails_its_job_as_it_fails_the_command_and_the_run_goes_on(
    site: BenchmarkedRun,
) -> None:
    asked = site.ask("--width", "100")
    truth, gone = site.folder / "truth.ply", site.folder / "gone.ply"

    def uninstall(_what: str, _done: int, _total: int) -> None:
        if truth.exists():
            truth.rename(gone)

    try:
        with site.machine(method=True), Store.open(site.data) as store:
            tries = work(store, until_idle=True, stop=lambda: False, progress=uninstall)
        assert tries == 3
    finally:
        gone.rename(truth)
    _, failed = site.event(JobFailed, asked["job"])
    assert failed.message.startswith("Shifted truth cannot run here: SHIFTED_TRUTH names no file")
    assert "Install that, or run these commands elsewhere" in failed.message
    assert read_run(site.data, "latest").state.status == "completed"
    assert verify(site.data).ok


def test_a_method_that_makes_no_mesh_has_an_answer_with_what_it_printed(site: BenchmarkedRun) -> None:
    asked = site.ask("--spacing-mm", "8")
    truth, away = site.folder / "truth.ply", site.folder / "away.ply"
    truth.rename(away)
    truth.touch()
    try:
        assert site.worker(method=True) == 1
    finally:
        away.replace(truth)
    _, end = site.event(JobFinished, asked["job"])
    assert end.result["score"] is None
    assert "nothing to copy" in end.result["failure"]
    assert "Its whole output is in output.txt" in end.result["failure"]
    (output,) = end.artefacts
    with Store.open(site.data) as store:
        printed = store.artefact_path(output.sha256).read_text(encoding="utf-8")
    assert printed.splitlines()[-1] == "nothing to copy"


def test_a_job_that_nobody_waits_for_is_printed_with_what_it_waits_for(site: BenchmarkedRun) -> None:
    command = ["benchmark", "run", "latest", "--method", METHOD, *ASKED, "--spacing-mm", "5", "--no-wait"]
    with site.machine(method=True, truth=False):
        done = CliRunner().invoke(app, [*command, "--data", str(site.data)], catch_exceptions=False)
    printed = " ".join(done.stdout.split())
    assert "waits for a worker on a machine with the file that SHIFTED_TRUTH names (not this one: " in printed
    assert "none of this folder listens. Start one: `orthocapture worker --kinds benchmark --data" in printed
    job = printed.split()[1]
    site.cancel(job)
    assert site.event(JobFailed, job)[1].message == "Erika cancelled it: asked by mistake"


def test_a_machine_computes_one_benchmark_at_a_time(site: BenchmarkedRun) -> None:
    asked = site.ask("--spacing-mm", "6")
    theirs = write_grant(site.data / "monitor" / "memory", os.getppid(), "theirs", 100, alone=True)
    try:
        assert site.worker(method=True) == 0
    finally:
        theirs.unlink()
    site.cancel(asked["job"])


@pytest.mark.slow
def test_a_worker_that_is_killed_takes_the_methods_process_with_it(site: BenchmarkedRun, tmp_path: Path) -> None:
    asked, started = site.ask("--spacing-mm", "7"), tmp_path / "pid"
    path = os.pathsep.join([str(site.folder / "package"), str(REPOSITORY)])
    has = {TRUTH: str(site.folder / "truth.ply"), ENDLESS: str(started), "PYTHONPATH": path}
    command = ["worker", "--kinds", "benchmark", "--jobs", "1", "--data", str(site.data)]
    worker = Forked([sys.executable, "-m", "service.cli.main", *command], env={**os.environ, **has}, cwd=REPOSITORY)
    try:
        until(lambda: started.is_file() and started.read_text() != "", "the method does not begin")
        (listening,) = living_workers(site.data, SystemClock())
        assert listening.kinds == ("benchmark",)
    finally:
        worker.kill()
        worker.wait(30)
    method = int(started.read_text())
    until(lambda: not psutil.pid_exists(method), "the method outlives its worker")
    site.cancel(asked["job"])


def test_what_cannot_be_a_job_is_refused(site: BenchmarkedRun, tmp_path: Path) -> None:
    def refused(*command: str) -> str:
        status, printed = site.call("benchmark", "run", *command)
        assert status == 1
        return str(printed["error"]["what"])

    (tmp_path / "folder").mkdir()
    common = ("--method", "stereo", "--scenario", "dense")
    assert "no run" in refused("2020", *common)
    assert "a mesh made elsewhere" in refused("latest", *common, "--mesh", "x.ply")
    assert "only the job of a run" in refused(str(tmp_path / "folder"), *common, "--no-wait")
    assert "there is no method" in refused("latest", "--method", "magic", "--scenario", "dense")
