"""Alerts for people who are elsewhere: what arrives at a web server and a mail server of this test."""

from __future__ import annotations

import json
import socketserver
import threading
from collections.abc import Generator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from service.core.errors import ConfigurationError
from service.monitor.alarm import Alarm
from service.monitor.reporter import OpenDevices, Reporter
from service.rig import AlertsSection, load_rig
from tests.support.processes.waiting import until
from tests.support.record.stepped_clock import SteppedClock
from tests.support.rig.bench_rig import BenchArm, BenchRig

RIG = "name: bench\nsimulated: true\ndevices: {}\n"


class Hook(BaseHTTPRequestHandler):
    """Accepts posts, after as many refusals as requested."""

    taken: list[dict[str, Any]]
    refusals: int = 0

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        kind = type(self)
        if kind.refusals:
            kind.refusals -= 1
            self.send_response(503)
        else:
            kind.taken.append(json.loads(body))
            self.send_response(200)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002 - as the base class names it
        pass


class MailServer(socketserver.StreamRequestHandler):
    """As much of SMTP (RFC 5321) as is needed to deliver one message."""

    letters: list[str]

    def handle(self) -> None:
        self._say("220 test")
        while line := self.rfile.readline().decode().strip():
            verb = line.split()[0].upper()
            if verb == "DATA":
                self._say("354 go on")
                letter = ""
                while (part := self.rfile.readline().decode()) != ".\r\n":
                    letter += part
                self.letters.append(letter)
            self._say("221 bye" if verb == "QUIT" else "250 ok")

    def _say(self, text: str) -> None:
        self.wfile.write(f"{text}\r\n".encode())


@contextmanager
def serving(server: socketserver.TCPServer) -> Generator[int]:
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server.socket.getsockname()[1]
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@pytest.fixture
def hook() -> Generator[tuple[type[Hook], str]]:
    kind = type("OneHook", (Hook,), {"taken": [], "refusals": 0})
    with serving(ThreadingHTTPServer(("127.0.0.1", 0), kind)) as port:
        yield kind, f"http://127.0.0.1:{port}/alerts"


def section(**fields: Any) -> AlertsSection:
    return AlertsSection.model_validate(fields)


def test_a_stop_is_told_at_once_and_once(hook: tuple[type[Hook], str]) -> None:
    kind, url = hook
    alarm = Alarm(section(webhook={"url": url}), "run-7", "bench")
    for _ in range(5):
        alarm.follow("stopped", "Capture: no link to the arm")
    alarm.close()
    assert [body["standing"] for body in kind.taken] == ["stopped"]
    assert kind.taken[0]["text"] == "Run run-7 has stopped: Capture: no link to the arm (rig bench)"
    assert kind.taken[0]["run"] == "run-7"


def test_waiting_is_told_when_it_has_lasted_and_again_after_work(hook: tuple[type[Hook], str]) -> None:
    kind, url = hook
    clock = SteppedClock()
    alarm = Alarm(section(webhook={"url": url}, waits_after_s=30), "run", "bench", clock=clock)
    for clock.passed_s in (0.0, 29.0):
        alarm.follow("waits", "Spray: a signature is due")
    course = (("works", 29.5), ("waits", 30.0), ("waits", 59.0), ("waits", 60.0), ("waits", 61.0))
    for standing, clock.passed_s in course:
        alarm.follow(standing, "Spray: a signature is due")  # type: ignore[arg-type]
    for standing, clock.passed_s in (("works", 70.0), ("waits", 71.0), ("waits", 102.0)):
        alarm.follow(standing, "Spray: a signature is due")  # type: ignore[arg-type]
    alarm.close()
    assert len(kind.taken) == 2


def test_what_is_not_asked_for_is_not_told(hook: tuple[type[Hook], str]) -> None:
    kind, url = hook
    alarm = Alarm(section(webhook={"url": url}, on=["ended"]), "run", "bench")
    alarm.follow("stopped", "no link")
    alarm.follow("ended", "it is completed")
    alarm.close()
    assert [body["standing"] for body in kind.taken] == ["ended"]


def test_a_server_that_refuses_is_asked_again(hook: tuple[type[Hook], str]) -> None:
    kind, url = hook
    kind.refusals = 1
    alarm = Alarm(section(webhook={"url": url}), "run", "bench", clock=SteppedClock())
    alarm.follow("stopped", "no link")
    alarm.close()
    assert len(kind.taken) == 1


def test_a_letter_arrives() -> None:
    kind = type("OneMailServer", (MailServer,), {"letters": []})
    with serving(socketserver.ThreadingTCPServer(("127.0.0.1", 0), kind)) as port:
        email = {"to": ["lab@example.org", "head@example.org"], "sender": "rig@example.org", "host": "127.0.0.1"}
        alarm = Alarm(section(email={**email, "port": port, "starttls": False}), "run-7", "bench")
        alarm.follow("ended", "it is completed")
        alarm.close()
    (letter,) = kind.letters
    assert "Subject: Run run-7 has ended" in letter
    assert "To: lab@example.org, head@example.org" in letter
    assert "Run run-7 has ended: it is completed (rig bench)" in letter


def test_the_reporter_tells_of_the_robots_stop_and_of_the_end(hook: tuple[type[Hook], str], tmp_path: Path) -> None:
    kind, url = hook
    arm = BenchArm()
    arm.open()
    devices = OpenDevices(robots={"robot": arm})
    alarm = Alarm(section(webhook={"url": url}, waits_after_s=0), "run", "bench")
    reporter = Reporter(tmp_path, "run", lambda: devices, BenchRig().camera_named, alarm)
    reporter.attend("working", "capture", 1)
    reporter.attend("asking", "capture", 1, asks="confirm", words="Capture: a confirmation is awaited")
    until(lambda: len(kind.taken) == 1, "no alert")
    arm.safety = type(arm.safety).PROTECTIVE_STOP
    reporter.attend("working", "capture", 2)
    reporter.outcome = "it is aborted: the board slipped"
    reporter.end()
    assert [(body["standing"], body["words"]) for body in kind.taken] == [
        ("waits", "Capture: a confirmation is awaited"),
        ("stopped", "the robot reports: protective stop"),
        ("ended", "it is aborted: the board slipped"),
    ]


@pytest.mark.parametrize(
    ("alerts", "words"),
    [
        ("{webhook: {}}", "give either url or url_env"),
        ("{webhook: {url: 'file:///etc/passwd'}}", "url"),
        ("{email: {to: [], sender: a, host: b}}", "to"),
    ],
)
def test_a_wrong_section_is_told_when_the_rig_file_is_read(alerts: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(RIG + f"alerts: {alerts}\n")
    with pytest.raises(ConfigurationError, match=words):
        load_rig(tmp_path / "rig.yaml")


def test_a_secret_comes_from_the_environment(
    hook: tuple[type[Hook], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind, url = hook
    (tmp_path / "rig.yaml").write_text(RIG + "alerts: {webhook: {url_env: LAB_HOOK}}\n")
    alerts = load_rig(tmp_path / "rig.yaml").section.alerts
    assert alerts is not None
    with pytest.raises(ConfigurationError, match="LAB_HOOK, which the rig file names for alerts, is not set"):
        Alarm(alerts, "run", "bench")
    monkeypatch.setenv("LAB_HOOK", "ftp://elsewhere")
    with pytest.raises(ConfigurationError, match="no webhook address"):
        Alarm(alerts, "run", "bench")
    monkeypatch.setenv("LAB_HOOK", url)
    alarm = Alarm(alerts, "run", "bench")
    alarm.follow("stopped", "no link")
    alarm.close()
    assert len(kind.taken) == 1
