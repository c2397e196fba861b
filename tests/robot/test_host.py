"""drivers.host: a driver in a child process that may crash, hang, misbehave or lose its parent."""

from __future__ import annotations

import logging
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Generator, Iterator
from contextlib import ExitStack, closing, contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

from drivers.errors import (
    DeviceFaultError,
    DeviceTimeoutError,
    DeviceUnavailableError,
    DriverKilledError,
    MachineBusyError,
    SafetyStopError,
)
from drivers.host import heartbeat, hosted_device
from drivers.host.hosted_device import HostedDevice, hosted
from drivers.interfaces import Array
from service.core.errors import ConfigurationError
from tests.support.processes.waiting import until
from tests.support.rig.host_fake_driver import Fake, FakeConfig

SPEC = "tests.support.rig.host_fake_driver:DRIVER"


@pytest.fixture(scope="module", autouse=True)
def forked_hosts() -> None:
    """Start processes for real: this is about their start and end."""


@pytest.fixture(scope="module")
def lasting() -> Iterator[Fake]:
    device = hosted(Fake, SPEC, FakeConfig(), call_timeout_s=20.0, name="fake one")
    yield device
    device.close()


@pytest.fixture
def fake(lasting: Fake) -> Fake:
    """A device that is open: the same for all, with a new process if a test has ended the one before."""
    lasting.open()
    return lasting


def test_calls_run_in_another_process_and_arrays_cross(fake: Fake) -> None:
    before, identity = fake.open(), fake.open()
    assert int(identity.serial) != os.getpid()
    assert identity.model == "hello"
    assert int(identity.firmware) == int(before.firmware) + 1, "the second open must reach the same driver object"
    np.testing.assert_array_equal(fake.double(np.arange(6.0), offset=1.0), 2 * np.arange(6.0) + 1)


def test_proxy_has_the_methods_of_the_interface_and_what_any_driver_may_offer(fake: Fake) -> None:
    public = {n for n in dir(type(fake)) if not n.startswith("_")}
    expected = {n for n in dir(Fake) if not n.startswith("_")}
    assert public == expected | {"answers"}


def test_stdin_is_dev_null(fake: Fake) -> None:
    assert fake.stdin_target() == os.devnull


def test_errors_of_our_tree_cross_unchanged(fake: Fake) -> None:
    with pytest.raises(SafetyStopError) as caught:
        fake.refuse()
    assert (caught.value.what, caught.value.where) == ("protective stop", "joint 3")
    assert caught.value.remedy == "Clear the cause"


def test_any_other_exception_is_wrapped(fake: Fake) -> None:
    with pytest.raises(DeviceFaultError, match="VendorError in blunder: the vendor says -7"):
        fake.blunder()
    with pytest.raises(DeviceFaultError, match="unpicklable"):
        fake.unpicklable()
    np.testing.assert_array_equal(fake.double(np.ones(2)), [2, 2])


def test_segfault_names_the_signal_and_open_restarts(fake: Fake) -> None:
    before = fake.open().serial
    with pytest.raises(DeviceUnavailableError, match="SIGSEGV"):
        fake.crash(signal.SIGSEGV)
    with pytest.raises(DeviceUnavailableError, match="SIGSEGV"):
        fake.double(np.ones(1))
    assert fake.open().serial != before
    np.testing.assert_array_equal(fake.double(np.ones(1)), [2])


def test_call_timeout_kills_the_child(tmp_path: Path) -> None:
    device = hosted(Fake, SPEC, FakeConfig(), call_timeout_s=1.5, name="slow")
    pid = int(device.open().serial)
    with pytest.raises(DeviceTimeoutError, match=r"hang did not return within 1\.5 s"):
        device.hang(600)
    assert not psutil.pid_exists(pid)
    with pytest.raises(DeviceUnavailableError, match="killed after hang"):
        device.double(np.ones(1))
    assert int(device.open().serial) != pid
    device.close()


def test_a_process_that_crashed_says_at_what_and_a_value_that_crashes_it_twice_is_left_out(fake: Fake) -> None:
    """Before, the words were "died of SIGSEGV | Open the device again", again and again."""
    for _ in range(2):
        with pytest.raises(DeviceUnavailableError, match="SIGSEGV in read_value, while reading the setting iso"):
            fake.read_value("crash")
        with pytest.raises(DeviceUnavailableError, match="while reading the setting iso"):
            fake.double(np.ones(1))
        fake.open()
    assert "Reading the setting iso has ended the driver's process 2 times" in fake.read_value("crash")
    np.testing.assert_array_equal(fake.double(np.ones(1)), [2])


def test_a_device_opens_without_the_value_that_crashes_its_driver() -> None:
    device = hosted(Fake, SPEC, FakeConfig(bad_value="crash"), call_timeout_s=20.0, name="bad")
    assert device.open().model == "hello"
    device.close()


def test_a_value_that_hangs_twice_is_left_out() -> None:
    device = hosted(Fake, SPEC, FakeConfig(), call_timeout_s=0.5, name="slow")
    for _ in range(2):
        device.open()
        with pytest.raises(DeviceTimeoutError, match=r"within 0\.5 s, while reading the setting iso"):
            device.read_value("hang")
    device.open()
    assert "left out" in device.read_value("hang")
    device.close()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGALRM, signal.SIGTERM])
def test_a_driver_that_is_ended_from_outside_says_so_until_it_is_opened_again(fake: Fake, number: int) -> None:
    for _ in range(2):
        with pytest.raises(
            DriverKilledError, match=f"died of {signal.Signals(number).name}; it was ended from outside"
        ):
            fake.crash(number)
    fake.open()
    np.testing.assert_array_equal(fake.double(np.ones(1)), [2])


@contextmanager
def crowded(pid: int, rivals: int = 4) -> Generator[None]:
    """Give a process one processor, together with so many others that compute without end."""
    processor = min(os.sched_getaffinity(0))
    loop = f"import os\nos.sched_setaffinity(0, {{{processor}}})\nprint(flush=True)\nwhile True: pass"
    with ExitStack() as stack:
        for _ in range(rivals):
            rival = stack.enter_context(subprocess.Popen([sys.executable, "-c", loop], stdout=subprocess.PIPE))
            stack.callback(rival.kill)
            assert rival.stdout is not None
            rival.stdout.readline()
        os.sched_setaffinity(pid, {processor})
        yield


@pytest.mark.slow
@pytest.mark.realtime
def test_a_call_that_waits_for_a_processor_is_given_that_time_besides() -> None:
    device = hosted(Fake, SPEC, FakeConfig(), call_timeout_s=1.5, name="squeezed")
    with closing(device), crowded(int(device.open().serial)):
        began_s = time.monotonic()
        device.burn(0.9)
        assert time.monotonic() - began_s > 1.5, "the machine was not crowded"


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("policy", [os.SCHED_OTHER, os.SCHED_IDLE], ids=["in turns", "at a stretch"])
def test_a_call_that_has_waited_long_enough_for_a_processor_names_the_machine(policy: int) -> None:
    """Linux counts a wait when it ends, which is after the time limit where the driver runs only once in seconds."""
    device = hosted(Fake, SPEC, FakeConfig(), call_timeout_s=0.5, name="squeezed")
    pid = int(device.open().serial)
    with closing(device), crowded(pid):
        os.sched_setscheduler(pid, policy, os.sched_param(0))
        began_s = time.monotonic()
        with pytest.raises(MachineBusyError, match="waited for a processor or for memory"):
            device.burn(20.0)
        assert time.monotonic() - began_s < 30.0


def test_a_process_that_cannot_be_started_is_the_machines_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    device = hosted(Fake, SPEC, FakeConfig(), call_timeout_s=30, name="unborn")
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with pytest.raises(MachineBusyError, match="cannot be started: No such file"):
        device.open()


def test_however_the_connection_to_an_open_device_ends_it_is_told_once(tmp_path: Path) -> None:
    ended: list[tuple[str, str]] = []
    device = hosted(
        Fake, SPEC, FakeConfig(), call_timeout_s=1.5, name="arm",
        on_end=lambda how, error: ended.append((how, type(error).__name__)),
    )  # fmt: skip
    with pytest.raises(DeviceUnavailableError):
        device.double(np.ones(1))
    assert ended == [], "it was never open"
    device.open()
    with pytest.raises(DeviceUnavailableError):
        device.crash(signal.SIGKILL)
    with pytest.raises(DeviceUnavailableError):
        device.double(np.ones(1))
    assert ended == [("died", "DriverKilledError")]
    device.open()
    with pytest.raises(DeviceTimeoutError):
        device.hang(600)
    assert ended[1:] == [("stalled", "DeviceTimeoutError")]
    device.open()
    for _ in range(2):
        with pytest.raises(DeviceUnavailableError):
            device.lose_link()
    assert ended[2:] == [("broken", "DeviceUnavailableError")]
    device.open()
    device.close()
    assert len(ended) == 3, "whoever closes a device has not lost it"


def test_a_device_that_does_not_tell_what_it_knows_is_given_less_time_than_a_long_call() -> None:
    """libgphoto2 hangs in `report` if a Canon's answers are noise; an exposure may take two minutes, a report not."""
    config = FakeConfig(report_s=600)
    device = hosted(Fake, SPEC, config, call_timeout_s=60, name="mute", reading_timeout_s=0.5)
    device.open()
    with pytest.raises(DeviceTimeoutError, match=r"report did not return within 0\.5 s"):
        device.report()
    device.open()
    device.hang(0.6)
    device.close()


def test_heartbeat_finds_a_child_that_died_between_calls(caplog: pytest.LogCaptureFixture) -> None:
    device = HostedDevice(SPEC, FakeConfig(), call_timeout_s=30, name="mortal", heartbeat_s=0.1)
    device.open()
    device.call("crash_later", 0.1)
    until(lambda: device.pid is None, "the death is noticed")
    until(lambda: any("SIGSEGV" in r.message for r in caplog.records if r.levelno == logging.ERROR), "it is logged")
    device.close()


def test_the_child_is_told_that_its_parent_lives_during_long_calls_too(fake: Fake) -> None:
    fake.beats()
    fake.hear(10)  # one call, which ends only when the beats arrive during it
    beats = list(fake.beats())
    assert len(beats) >= 10
    until(lambda: len(beats) > 25 or bool(beats.extend(fake.beats())), "no beats between calls")
    assert all(arrived_s >= sent_s for sent_s, arrived_s in beats)
    gaps_s = np.diff([sent_s for sent_s, _ in beats])
    assert np.all(gaps_s > 0)
    assert np.min(gaps_s) < 2 * heartbeat.BEAT_S


@pytest.mark.realtime
def test_no_beat_while_the_parent_stands_still() -> None:
    program = (
        "import sys\n"
        "from drivers.host.hosted_device import hosted\n"
        "from tests.support.rig.host_fake_driver import Fake, FakeConfig\n"
        f"d = hosted(Fake, {SPEC!r}, FakeConfig(), call_timeout_s=20, name='watched')\n"
        "d.open()\n"
        "d.hear(3)\n"
        "print('open', flush=True)\n"
        "sys.stdin.readline()\n"
        "beats = list(d.beats())\n"
        "until_now = len(beats)\n"
        "while len(beats) == until_now: beats += d.beats()\n"  # the first one after the pause may still be on its way
        "sent = [at for at, _ in beats]\n"
        "print(max(b - a for a, b in zip(sent, sent[1:])), flush=True)\n"
        "d.close()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdin is not None
        assert parent.stdout is not None
        assert parent.stdout.readline() == "open\n"
        parent.send_signal(signal.SIGSTOP)
        until(lambda: psutil.Process(parent.pid).status() == psutil.STATUS_STOPPED, "it is stopped")
        time.sleep(1.0)
        parent.send_signal(signal.SIGCONT)
        parent.stdin.write("\n")
        parent.stdin.flush()
        assert float(parent.stdout.readline()) >= 1.0


def test_a_child_that_does_not_read_holds_its_parent_up_for_no_beat(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(heartbeat, "BEAT_S", 0.001)
    device = hosted(Fake, SPEC, FakeConfig(), call_timeout_s=20.0, name="stopped")
    pid = int(device.open().serial)
    os.kill(pid, signal.SIGSTOP)
    line = vars(device)["hosted_device"]._child.line
    until(lambda: is_full(line._connection), "the beats do not fill the socket")
    assert line._lock.acquire(timeout=60), "a beat waits, and a call could not be sent"
    line._lock.release()
    answers: list[Array] = []
    call = threading.Thread(target=lambda: answers.append(device.double(np.ones(1))))
    call.start()
    os.kill(pid, signal.SIGCONT)
    call.join()
    np.testing.assert_array_equal(answers, [[2]])
    device.close()


def is_full(connection: Connection) -> bool:
    return not select.select([], [connection], [], 0.0)[1]


def test_output_of_the_child_goes_to_logging(
    fake: Fake, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    caplog.set_level(logging.INFO)
    fake.talk()
    until(lambda: "vendor chatter on stdout" in caplog.messages, "the vendor's line")
    until(lambda: "pydicom: words of a library" in caplog.messages, "the library's line")
    levels = {record.message.partition(": ")[2]: record.levelname for record in caplog.records}
    assert (levels["the driver warns"], levels["words of a library"]) == ("WARNING", "INFO")
    out, err = capfd.readouterr()
    assert "chatter" not in out + err


def test_close_closes_the_device_and_ends_the_child(tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    device = hosted(Fake, SPEC, FakeConfig(trace=trace), call_timeout_s=30, name="tidy")
    pid = int(device.open().serial)
    device.close()
    assert trace.read_text() == "closed"
    assert not psutil.pid_exists(pid)
    device.close()
    with pytest.raises(DeviceUnavailableError, match="closed"):
        device.double(np.ones(1))


def test_a_driver_that_does_not_close_is_waited_for_for_seconds_and_then_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A program that ends waits for it; libraries need a few seconds for a device that has gone."""
    device = hosted(Fake, SPEC, FakeConfig(), call_timeout_s=300, name="stuck")
    pid = int(device.open().serial)
    waited_s: list[float] = []

    def no_answer(_line: heartbeat.Line, timeout_s: float) -> bool:
        waited_s.append(timeout_s)
        return False

    monkeypatch.setattr(hosted_device, "time", SimpleNamespace(monotonic=lambda: sum(waited_s)))
    monkeypatch.setattr(heartbeat.Line, "poll", no_answer)
    device.close()
    assert 5 < sum(waited_s) < 30
    assert not psutil.pid_exists(pid)


def test_calls_before_open_are_refused() -> None:
    device = hosted(Fake, SPEC, FakeConfig(), call_timeout_s=30, name="early")
    with pytest.raises(DeviceUnavailableError, match="not opened yet"):
        device.report()


@pytest.mark.parametrize("spec", ["tests.support.nowhere:DRIVER", "tests.support.rig.host_fake_driver:NOT_A_DRIVER"])
def test_wrong_spec_is_a_configuration_error(spec: str) -> None:
    device = hosted(Fake, spec, FakeConfig(), call_timeout_s=30, name="wrong")
    with pytest.raises(ConfigurationError, match=spec):
        device.open()


def test_child_that_dies_while_opening() -> None:
    device = hosted(Fake, SPEC, FakeConfig(die_on_open=True), call_timeout_s=30, name="stillborn")
    with pytest.raises(DeviceUnavailableError, match="exited with status 3"):
        device.open()


@pytest.mark.parametrize("busy", [False, True])
def test_child_exits_when_its_parent_is_killed(tmp_path: Path, busy: bool) -> None:
    trace, hangs = tmp_path / "trace", tmp_path / "hangs"
    files = {"trace": str(trace), "hangs": str(hangs)}
    program = (
        "import signal\n"
        "from drivers.host.hosted_device import hosted\n"
        "from tests.support.rig.host_fake_driver import Fake, FakeConfig\n"
        f"d = hosted(Fake, {SPEC!r}, FakeConfig(**{files!r}), call_timeout_s=20, name='orphan')\n"
        "print(d.open().serial, flush=True)\n"
        f"d.hang(1.0) if {busy} else None\n"
        "signal.pause()\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        if busy:
            until(hangs.exists, "the call does not begin")
        parent.kill()
    until(lambda: not psutil.pid_exists(pid), "the child exits")
    assert trace.read_text() == "closed", "an orphaned driver must still let go of its device"
