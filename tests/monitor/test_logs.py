"""Logs: JSON lines with run, step, viewpoint and process; bounded; none on the last gigabyte; no secrets."""

from __future__ import annotations

import io
import json
import logging
import subprocess
import sys
from collections.abc import Generator
from pathlib import Path
from typing import Any

import httpx
import pytest

from drivers.host.hosted_device import hosted
from service.logs import LOG_NAME, BoundedFile, file_log, without_secrets
from service.store.records import NewJob
from service.store.store import Store
from service.worker.loop import work
from tests.support.processes.forked import Forked, run
from tests.support.record.store import capture, enqueue, start_run
from tests.support.rig.host_fake_driver import Fake, FakeConfig
from tests.support.rig.rig import REPOSITORY, command
from tests.support.runs.bench_run import PROTOCOL, begin_run, record_runs

_log = logging.getLogger("service.test")


def lines(data: Path) -> list[dict[str, Any]]:
    """Every line, oldest file first."""
    folder = data / "logs"
    files = sorted(folder.glob("*.jsonl"), key=lambda path: -int(path.name.split(".")[1].replace("jsonl", "0")))
    return [json.loads(line) for path in files for line in path.read_text().splitlines()]


@pytest.fixture
def terminal() -> Generator[io.StringIO]:
    """What the command line shows on stderr, as configured by service.cli.main."""
    shown = io.StringIO()
    handler = logging.StreamHandler(shown)
    root = logging.getLogger()
    before, level = root.handlers[:], root.level
    root.handlers = [handler]
    root.setLevel(logging.WARNING)
    yield shown
    root.handlers = before
    root.setLevel(level)


def test_a_run_says_of_what_it_speaks_and_the_terminal_shows_what_it_showed(
    tmp_path: Path, terminal: io.StringIO
) -> None:
    with Store.open(tmp_path / "data") as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        bench.rig.shutter.on_capture = lambda _number: _log.info("the shutter was released")
        with file_log(tmp_path / "data", "runner", run=bench.run_id):
            bench.run()
            _log.warning("the lens is cold")
        captured, events = bench.captured(), store.events(bench.run_id)
    said = lines(tmp_path / "data")
    assert {(line["process"], line["run"]) for line in said} == {("runner", bench.run_id)}
    assert all(line["at_utc"].endswith("Z") and line["level"] in ("info", "warning") for line in said)
    released = [line for line in said if line["event"] == "the shutter was released"]
    assert [line["viewpoint"] for line in released] == captured
    assert {line["step"] for line in released} == {"capture"}
    recorded = [line for line in said if line["event"] == "viewpoint_captured"]
    assert [(line["viewpoint"], line["seq"]) for line in recorded] == [
        (e.payload.viewpoint, e.seq)  # type: ignore[union-attr]
        for e in events
        if e.payload.kind == "viewpoint_captured"
    ]
    (measured,) = [line for line in said if line["event"] == "step_measured" and line["step"] == "capture"]
    assert "viewpoint" not in measured
    assert "step_passed" in {line["event"] for line in said}
    assert {line["logger"].split(".")[0] for line in said} == {"service"}  # no debug messages of libraries
    assert terminal.getvalue() == "the lens is cold\n"


@pytest.mark.slow
def test_the_processes_of_a_run_log_and_speak_to_the_terminal_as_ever(tmp_path: Path) -> None:
    _, begun = record_runs(tmp_path)
    resume = command("resume", "latest", "--data", str(tmp_path / "data"))
    done = run(resume, cwd=REPOSITORY, typed="abort a test\n", timeout_s=100)
    assert f"Run {begun} is aborted" in done.stdout
    assert "Type one of: confirm" in done.stderr
    assert '{"' not in done.stdout + done.stderr
    said = [line for line in lines(tmp_path / "data") if line["process"] == "runner"]
    assert {line["run"] for line in said} == {begun}
    assert [line["event"] for line in said] == ["session_started", "operator_action"]


def test_what_a_drivers_own_process_says_is_there_under_its_name(tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    spec = "tests.support.rig.host_fake_driver:DRIVER"
    with file_log(data, "runner", run="r1"):
        device = hosted(Fake, spec, FakeConfig(), call_timeout_s=20.0, name="camera")
        device.open()
        device.talk()
        device.close()
    of_driver = [line for line in lines(data) if line["process"] == "driver camera"]
    assert of_driver
    assert {line["run"] for line in of_driver} == {"r1"}


def test_a_worker_says_which_job_of_which_run_failed_and_why(tmp_path: Path) -> None:
    with Store.open(tmp_path / "data") as store:
        run_id = start_run(store)
        arguments = {"mesh": "0" * 64, "radius_m": 0.015, "expected": 10}
        job = enqueue(store, run_id, NewJob("locate_spheres", "scan", 1, "key", arguments), actor="test")
        with file_log(tmp_path / "data", "worker"):
            work(store, until_idle=True, stop=lambda: False, progress=lambda _what, _done, _total: None)
    (failed,) = [line for line in lines(tmp_path / "data") if line["event"] == "job_failed"]
    assert (failed["run"], failed["step"], failed["job"], failed["process"]) == (run_id, "scan", job.job_id, "worker")
    assert "missing" in failed["words"]


def test_an_error_that_nobody_foresaw_comes_with_its_traceback_on_one_line(tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    with file_log(data, "web"):
        try:
            {}["v1_003"]
        except KeyError:
            _log.exception("it went wrong")
    (line,) = lines(data)
    assert "Traceback" in line["exception"]
    assert "KeyError: 'v1_003'" in line["exception"]


_WRITER = """
import logging, sys
from pathlib import Path
from service.logs import BoundedFile
from service.logs import file_log
data = Path(sys.argv[1])
with file_log(data, sys.argv[2], handler=BoundedFile(data, file_bytes=20_000, files=4)):
    for number in range(300):
        logging.getLogger("service.w").info("line %d %s", number, "x" * 150)
"""


@pytest.mark.slow
def test_several_processes_share_a_log_that_is_bounded(tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    writers = [
        subprocess.Popen([sys.executable, "-c", _WRITER, str(data), name], cwd=REPOSITORY) for name in ("a", "b", "c")
    ]
    assert [writer.wait(timeout=60) for writer in writers] == [0, 0, 0]
    files = list((data / "logs").glob("*.jsonl"))
    assert len(files) == 4
    assert all(path.stat().st_size <= 20_000 for path in files)
    assert sum(path.stat().st_size for path in files) > 60_000
    said = lines(data)  # complete lines, all of them
    for name in ("a", "b", "c"):
        numbers = [int(line["event"].split()[1]) for line in said if line["process"] == name]
        assert numbers == sorted(numbers)
    assert 299 in {int(line["event"].split()[1]) for line in said}


def test_on_the_last_gigabyte_the_log_stops_with_one_line_and_the_run_goes_on(tmp_path: Path) -> None:
    free = [2 << 30]
    data = tmp_path / "data"
    with Store.open(data) as store:
        bench = begin_run(store, PROTOCOL, tmp_path)
        bench.rig.shutter.on_capture = lambda number: free.__setitem__(0, 1000 if number == 2 else free[0])
        with file_log(data, "runner", handler=BoundedFile(data, free_bytes=lambda _folder: free[0])):
            assert bench.run().status == "completed"
            size = (data / "logs" / LOG_NAME).stat().st_size
            _log.error("nobody hears this")
            assert (data / "logs" / LOG_NAME).stat().st_size == size
            free[0] = 2 << 30
            _log.error("this again")
        bench.must_verify()
        assert len(bench.captured()) == 4
    said = lines(data)
    stops = [number for number, line in enumerate(said) if "logging stops until" in line["event"]]
    assert len(stops) == 1
    assert [line["event"] for line in said[stops[0] + 1 :]] == ["logging resumes: there is space again", "this again"]
    assert sum(line["event"] == "viewpoint_captured" for line in said) < 4


def test_a_log_that_cannot_be_written_disturbs_nothing(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with Store.open(data) as store, file_log(data, "runner"):
        (data / "logs").write_text("a file where the folder would be")
        run_id = start_run(store)
        capture(store, run_id, "v1")
        assert len(store.events(run_id)) == 2
    assert (data / "logs").read_text() == "a file where the folder would be"


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        ("GET /set-up/s3cr3t failed", "GET /set-up/"),
        ("http://127.0.0.1:80/set-up/s3cr3t?x=1", "127.0.0.1"),
        ("password=s3cr3t, name=ada", "name=ada"),
        ("{'password': 's3cr3t', 'name': 'ada'}", "'name': 'ada'"),
        ('{"pin": "s3cr3t", "account": "ada"}', '"account": "ada"'),
        ("csrf=s3cr3t&verb=confirm", "verb=confirm"),
        ("Authorization: Bearer s3cr3t", "Authorization"),
        ("Cookie: __Host-orthocapture=s3cr3t; theme=dark", "Cookie"),
        ("smb://lab:s3cr3t@nas/share", "@nas/share"),
        ("hash is $argon2id$v=19$m=8$s3cr3t", "hash is "),
        ("-----BEGIN PRIVATE KEY-----\ns3cr3t\n-----END PRIVATE KEY-----\nafter", "after"),
        ("new_password: s3cr3t", "new_password"),
    ],
)
def test_secrets_are_taken_out_and_the_rest_is_kept(tmp_path: Path, text: str, kept: str) -> None:
    data = tmp_path / "data"
    data.mkdir()
    with file_log(data, "web"):
        _log.error("%s", text)
        _log.error("fields", extra={"form": {"account": "ada", "password": "s3cr3t"}, "session_token": "s3cr3t"})
        try:
            int(text)
        except ValueError:
            _log.exception("with a traceback")
    content = (data / "logs" / LOG_NAME).read_text()
    assert "s3cr3t" not in content
    said = [json.loads(line) for line in content.splitlines()]
    assert kept in said[0]["event"]
    assert said[1]["form"]["account"] == "ada"


def test_what_is_no_secret_stays() -> None:
    for text in ("pinned at 3 px", "step capture: passed", "viewpoint v1_003, token bucket", "/runs/2026-1/stream"):
        assert without_secrets(text) == text
    assert without_secrets({"passed": 3, "pin_failures": 2}) == {"passed": 3, "pin_failures": 2}


@pytest.mark.slow
def test_a_server_logs_no_password_pin_token_or_link(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text("name: a small site\nsimulated: true\ndevices: {}\n")
    data = tmp_path / "data"
    words = command("serve", "--rig", str(rig), "--data", str(data), "--port", "0", "--json")
    with Forked(words, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            ready = json.loads(server.stdout.readline())
            secret = {"password": "correct horse battery", "pin": "864201"}
            with httpx.Client(base_url=ready["url"], timeout=60) as browser:
                form = {"account": "ada", "full_name": "Ada Lovelace", "repeated": secret["password"], **secret}
                made = browser.post(ready["set_up"], data=form)
                assert made.status_code in (200, 303), made.text
                browser.post("/sign-in", data={"account": "ada", "password": "a wrong guess 1"})
                signed = browser.post("/sign-in", data={"account": "ada", "password": secret["password"]})
                assert signed.status_code == 303
                cookies = list(browser.cookies.jar)
                assert cookies
                browser.post("/sign-out", data={"csrf": "of somebody else"})
        finally:
            server.terminate()
        assert server.wait(timeout=90) == 0
    said = lines(data)
    assert {line["process"] for line in said} == {"web"}
    assert ("POST", "/sign-in", 303) in {(line.get("method"), line.get("route"), line.get("status")) for line in said}
    assert ("POST", "/set-up/{token}") in {(line.get("method"), line.get("route")) for line in said}
    content = (data / "logs" / LOG_NAME).read_text()
    for word in (*secret.values(), "a wrong guess 1", ready["set_up"].split("/")[-1], "of somebody else"):
        assert word not in content
    assert all(str(cookie.value) not in content for cookie in cookies)
