"""A whole site as processes, most of which are killed during a run: it ends registered, verified and exported."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, cast

import distributed
import httpx
import pytest
import yaml

from service.core.records.run_events import (
    JobFinished,
    RunCompleted,
    SessionStarted,
    StepMeasured,
    StepStarted,
    ViewpointCaptured,
)
from service.dataset.export_folder import check_folder
from service.store.database.postgres import EVIDENCE
from service.store.objects.spool import spool_level
from service.store.store import Store
from tests.support.processes.cluster import end_tree
from tests.support.processes.postgres import ROLE
from tests.support.processes.site import Screens, Site, process_of, screens, site_servers, worker_command
from tests.support.processes.waiting import until
from tests.support.protocols.one_side import VIEWS, one_side
from tests.support.protocols.small_demo import COARSE
from tests.support.rig.rig import orthocapture, simulated_rig

pytestmark = [pytest.mark.slow, pytest.mark.whole, pytest.mark.packages("postgresql"), pytest.mark.timeout(2400)]
HOST = "127.0.0.46"
OPTIONS = ("--scene", "7", "--image-width", "640", *COARSE, "--speed-up", "10")
T = TypeVar("T")


@dataclass(frozen=True)
class Ended:
    """A run of a site that came to its end although the site was killed piece by piece."""

    site: Site
    screens: Screens
    run: str
    log: str  # of all processes
    folder: Path


def recorded(site: Site, kind: type[T]) -> list[T]:
    """Return the recorded events of a kind so far, read in this process."""
    with Store.open(site.data, create=False) as store:
        found = [event.payload for run in store.runs() for event in store.events(run.run_id)]
    return [payload for payload in found if isinstance(payload, kind)]


def reached(condition: Callable[[], bool], log: Path, *processes: subprocess.Popen[bytes]) -> None:
    """Wait for a condition while the processes live."""

    def alive_and_reached() -> bool:
        ended = [process for process in processes if process.poll() is not None]
        assert not ended, log.read_text(encoding="utf-8")
        return condition()

    until(alive_and_reached, lambda: log.read_text(encoding="utf-8"), 900.0, every_s=1.0)


def count_answers(dask_scheduler: distributed.Scheduler) -> int:
    """The number of tasks that the workers have answered so far; runs in the scheduler."""
    return sum(prefix.state_counts["memory"] for prefix in dask_scheduler.task_prefixes.values())


@contextmanager
def killed_while_computing(site: Site) -> Generator[Callable[[], None]]:
    """Provide what kills a worker of the cluster, and then its scheduler, in the midst of the next job's tasks.

    One worker is stopped first, so that its tasks have no answer when it is killed.
    """
    with distributed.Client(site.dask.address, set_as_default=False) as client:

        def answers() -> int:
            return cast("int", client.run_on_scheduler(count_answers))

        before = answers()
        last = site.dask.workers[-1]
        os.kill(last.pid, signal.SIGSTOP)

        def kill() -> None:
            until(lambda: answers() > before, "no task has an answer of the cluster", 300.0, every_s=0.02)
            end_tree(last)
            now = answers()
            until(lambda: answers() > now, "the other worker does not go on", every_s=0.02)
            client.close()
            end_tree(site.dask.scheduler)

        yield kill


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> Generator[Ended]:
    folder = tmp_path_factory.mktemp("site")
    protocol = folder / "one_side.yaml"
    protocol.write_text(yaml.safe_dump(one_side("robot_corrected"), sort_keys=False, allow_unicode=True), "utf-8")
    run_log, worker_log = folder / "run.log", folder / "worker.log"
    with ExitStack() as stack:
        site = stack.enter_context(site_servers(folder))
        (folder / "rig").mkdir()
        rig = Path(stack.enter_context(simulated_rig(folder / "rig", *OPTIONS, host=HOST))["rig"])
        web = stack.enter_context(screens(rig, site.data, folder))
        worker = stack.enter_context(process_of(worker_command(site.data), worker_log, site.worker_environment))
        about = ("--data", str(site.data), "--auto-confirm", "--no-worker", "--json")
        arguments = ("run", str(protocol), "--rig", str(rig), "--operator", "Ada", *about)

        with process_of(arguments, run_log) as runner:
            reached(lambda: len(recorded(site, ViewpointCaptured)) >= 2, run_log, runner, worker)
            site.weed.kill()
            in_front = "viewpoint_capture_1"
            reached(
                lambda: any(view.step == in_front for view in recorded(site, ViewpointCaptured)),
                run_log, runner, worker,
            )  # fmt: skip
            os.kill(runner.pid, signal.SIGKILL)
            runner.wait(timeout=60)
        assert not recorded(site, RunCompleted)

        with process_of(("resume", "latest", *about), run_log) as runner, killed_while_computing(site) as kill:
            reached(
                lambda: any(event.step == "registration" for event in recorded(site, StepStarted)),
                run_log,
                runner,
                worker,
            )
            kill()
            reached(lambda: bool(recorded(site, RunCompleted)), run_log, worker)
            site.weed.start()
            assert runner.wait(timeout=300) == 0, run_log.read_text(encoding="utf-8")
        with Store.open(site.data, create=False) as store:
            run = store.find_run("latest")
        until(lambda: not waiting(site), "the spool does not drain by itself", 600.0, every_s=0.5)
        log = (site.data / "logs" / "orthocapture.jsonl").read_text(encoding="utf-8")
        yield Ended(site, web, run, log, folder)


def waiting(site: Site) -> int:
    """The number of recorded files that the object store has not confirmed."""
    with Store.open(site.data, create=False) as store:
        state = spool_level(store)
    assert state is not None
    return state.waiting.files


def of_site(ended: Ended, *arguments: str, status: int = 0) -> str:
    answer = orthocapture(*arguments, "--data", str(ended.site.data), timeout_s=300)
    assert answer.returncode == status, answer.stdout + answer.stderr
    return answer.stdout


def said_at(ended: Ended, text: str) -> str:
    """The time at which a process first wrote a text into its log."""
    lines = [json.loads(line) for line in ended.log.splitlines()]
    return str(next(line["at_utc"] for line in lines if text in line["event"]))


def test_every_kill_left_its_mark_and_the_run_is_whole(ended: Ended) -> None:
    site = ended.site
    assert len(recorded(site, SessionStarted)) == 2, "the runner was killed and begun again"
    away, back = (said_at(ended, text) for text in ("nothing is uploaded", "the object store answers again"))
    with Store.open(site.data, create=False) as store:
        events = store.events(ended.run)
    taken = [event.at_utc for event in events if isinstance(event.payload, ViewpointCaptured)]
    assert sum(away < at_utc < back for at_utc in taken) > 2 * VIEWS, "captures go on without the object store"
    assert said_at(ended, "the cluster is lost")
    (search,) = [job for job in recorded(site, JobFinished) if job.job_kind == "detect_spheres"]
    assert search.computed_on is not None
    # The last answers may be lost with the scheduler, on their way.
    assert sum(host.tasks for host in search.computed_on.cluster) >= 1, "the cluster gave answers before it died"
    captured = [view.viewpoint for view in recorded(site, ViewpointCaptured) if view.viewpoint[0] in "vc"]
    assert sorted(captured) == sorted(f"{prefix}1_{i:03d}" for prefix in "vc" for i in range(1, VIEWS + 1))
    measures = {name: value for event in recorded(site, StepMeasured) for name, value in event.measures.items()}
    assert measures["robot_corrected_markers"] == 10
    assert measures["best_mean_radial_error_mm"] < 0.35
    assert json.loads(of_site(ended, "audit", "verify", "all", "--json"))["ok"]


def test_the_screens_serve_it(ended: Ended) -> None:
    health = ended.screens.get("/health")
    assert (health.status_code, health.json()["ok"]) == (200, True), health.text
    first = httpx.get(ended.screens.set_up, verify=ended.screens.trust, timeout=60)
    assert first.status_code == 200


def test_its_data_set_is_fetched_from_the_store(ended: Ended) -> None:
    freed = json.loads(of_site(ended, "store", "gc", "--spool", "--remove", "--json"))["freed"]
    photographs = {view.artefacts[0].sha256 for view in recorded(ended.site, ViewpointCaptured)}
    assert photographs <= {file["sha256"] for file in freed}
    of_site(ended, "export", ended.run, "--format", "plain", "--out", str(ended.folder / "dataset"))
    assert check_folder(ended.folder / "dataset") > 2 * VIEWS
    fetched = {path.name for path in (ended.site.data / "fetched").rglob("*")}
    views = {shot.artefacts[0].sha256 for shot in recorded(ended.site, ViewpointCaptured) if shot.viewpoint[0] == "v"}
    assert views <= fetched


def test_the_embedded_default_has_equal_heads_and_computes_equal_figures(ended: Ended) -> None:
    """Two captures of a scene differ in their times and so in their heads: the same evidence is compared.

    What the cluster computed before and while it died is computed again by this process alone, from the copied files.
    """
    alone = ended.folder / "embedded"
    copied = orthocapture("store", "copy", str(ended.site.data), str(alone), "--operator", "Ada", timeout_s=300)
    assert copied.returncode == 0, copied.stdout + copied.stderr
    heads: list[str] = []
    for folder in (ended.site.data, alone):
        answer = orthocapture("audit", "verify", ended.run, "--json", "--data", str(folder), timeout_s=300)
        assert answer.returncode == 0, answer.stdout
        heads.append(json.loads(answer.stdout)["heads"][ended.run])
    assert heads[0] == heads[1]
    again = orthocapture("replay", ended.run, "--json", "--data", str(alone), timeout_s=600)
    said = json.loads(again.stdout)
    assert said["verdict"] == "identical", again.stdout[-3000:]
    assert {"calibrate", "detect_spheres", "register", "evaluate"} <= {job["kind"] for job in said["jobs"]}


def test_psql_as_the_programs_role_changes_no_evidence(ended: Ended) -> None:
    site = ended.site
    rows = {table: site.postgres.run(site.database, f"SELECT * FROM {table} ORDER BY 1, 2") for table in EVIDENCE}
    assert all(rows[table] for table in EVIDENCE if table != "timestamps")
    statements: list[str] = []
    for table in EVIDENCE:
        named = f"SELECT attname FROM pg_attribute WHERE attrelid = '{table}'::regclass AND attnum = 1"
        ((column,),) = site.postgres.run(site.database, named)
        statements += [f"UPDATE {table} SET {column} = {column};", f"DELETE FROM {table};"]
        statements += [f"TRUNCATE {table};", f"TRUNCATE {table} CASCADE;"]
    done = subprocess.run(
        ["psql", "--no-psqlrc", "--dbname", site.postgres.url(site.database, ROLE)],
        input="\n".join(statements), capture_output=True, text=True, check=False,
    )  # fmt: skip
    refused = [line for line in done.stderr.splitlines() if "ERROR:  permission denied for table" in line]
    assert len(refused) == len(statements), done.stderr
    assert done.stdout == ""
    assert rows == {
        table: site.postgres.run(site.database, f"SELECT * FROM {table} ORDER BY 1, 2") for table in EVIDENCE
    }
