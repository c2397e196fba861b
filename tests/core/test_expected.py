"""What is said of how long a step takes: from earlier runs, from the protocol, and when it is not normal any more."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta

import pytest

from service.core.records.run_events import LeaveLapsed, StepMeasured
from service.core.run.expected import away_words, run_words, step_words, work_words
from service.monitor.figures import read_step_times
from tests.support.record.core import GOOD, TOY, Log, toy_protocol
from tests.support.record.core_log import at_capture, at_scan
from tests.support.runs.bench_fixtures import begin
from tests.support.runs.bench_run import PROTOCOL, Bench

__all__ = ["begin"]
TEN, NOW = [600.0, 540.0, 700.0], "2026-11-21T00:00:00.100000Z"


def hhmm(at_utc: str) -> str:
    return at_utc[11:16]


def later(minutes: float) -> str:
    return (datetime.fromisoformat(NOW) + timedelta(minutes=minutes)).isoformat()


def capturing(text: str = TOY) -> Log:
    log = Log(toy_protocol(text))
    log.do()
    log.begin()
    return log


def test_a_step_says_how_long_it_usually_takes_here_and_until_when() -> None:
    log = capturing()
    words = work_words(log.protocol, log.state, {"capture": TEN}, NOW, hhmm)
    assert words == "Usually 10 min (3 earlier runs on this site); started at 00:00, so until about 00:10."


def test_the_protocols_estimate_is_said_before_the_first_run() -> None:
    log = capturing(TOY.replace("    title: Capture\n", "    title: Capture\n    takes_s: 300\n"))
    assert "Usually 5 min (by the protocol)" in work_words(log.protocol, log.state, {}, NOW, hhmm)
    assert "3 earlier runs" in work_words(log.protocol, log.state, {"capture": TEN}, NOW, hhmm)


def test_what_is_not_known_is_not_guessed() -> None:
    log = capturing()
    words = work_words(log.protocol, log.state, {}, NOW, hhmm)
    assert words == "Started at 00:00; how long it takes is not known yet on this site."
    assert away_words(log.protocol, log.state, {}, NOW, hhmm) == ""


@pytest.mark.parametrize(("minutes", "normal"), [(11, True), (14, True), (16, False)])
def test_longer_than_ever_and_by_half_is_not_normal(minutes: int, normal: bool) -> None:
    log = capturing()
    words = work_words(log.protocol, log.state, {"capture": TEN}, later(minutes), hhmm)
    assert ("not normal any more" in words) != normal
    assert normal or "That is 16 min ago, and longer than ever before (12 min)" in words


def test_one_can_leave_until_the_next_question() -> None:
    log = capturing()
    words = away_words(log.protocol, log.state, {"capture": TEN}, later(4), hhmm)
    assert words.startswith("You can leave until 00:10."), "then a signature is due"
    scanning = at_scan()
    scanning.begin()
    earlier = {"scan": [300.0], "register": [1200.0]}
    words = away_words(scanning.protocol, scanning.state, earlier, NOW, hhmm)
    assert words.startswith("You can leave until 00:25."), "the next step begins by itself"
    words = away_words(scanning.protocol, scanning.state, {"scan": [300.0]}, NOW, hhmm)
    assert words.startswith("You can leave at least until about 00:05: how long “Register” takes is not known")


def test_nobody_is_sent_away_who_is_asked() -> None:
    earlier = {"capture": TEN, "spray": TEN}
    asked = at_capture()
    assert away_words(asked.protocol, asked.state, earlier, NOW, hhmm) == ""
    assert work_words(asked.protocol, asked.state, earlier, NOW, hhmm) == ""
    log = capturing()
    assert log.state.leave is not None
    log.append(LeaveLapsed(leave_seq=log.state.leave.seq, idle_s=90, limit_s=60))
    assert away_words(log.protocol, log.state, earlier, NOW, hhmm) == ""
    paused = capturing()
    paused.act("pause")
    assert away_words(paused.protocol, paused.state, earlier, NOW, hhmm) == ""
    assert away_words(log.protocol, capturing().state, {"capture": [15.0]}, NOW, hhmm) == "", "nobody leaves for that"


def test_the_times_are_those_of_earlier_runs_of_this_protocol(begin: Callable[[str], Bench]) -> None:
    first, other = begin(PROTOCOL), begin(PROTOCOL.replace("id: bench", "id: another"))
    for bench, seconds in ((first, 30.0), (other, 500.0)):
        slow = bench.clock
        bench.rig.shutter.on_capture = lambda _exposure, slow=slow, seconds=seconds: slow.sleep(seconds / 4)
        assert bench.run().status == "completed"
    assert read_step_times(first.store, first.run_id) == {}
    mine = begin(PROTOCOL)
    times = read_step_times(mine.store, mine.run_id)
    assert set(times) == {"fixation", "capture", "spraying"}
    assert times["capture"] == [pytest.approx(30.0, abs=3.0)]


def test_an_attempt_that_was_paused_does_not_tell_how_long_it_takes(begin: Callable[[str], Bench]) -> None:
    bench = begin(PROTOCOL)
    waits_s = iter([900.0])

    def pause(_exposure: object) -> None:
        for seconds in waits_s:
            bench.act("pause")
            bench.clock.sleep(seconds)
            bench.act("resume")

    bench.rig.shutter.on_capture = pause
    assert bench.run().status == "completed"
    assert set(read_step_times(bench.store, begin(PROTOCOL).run_id)) == {"fixation", "spraying"}


def test_no_time_is_told_once_the_figures_are_there() -> None:
    log = at_capture()
    log.begin()
    log.append(StepMeasured(step="capture", attempt=1, measures=GOOD))
    assert work_words(log.protocol, log.state, {"capture": TEN}, NOW, hhmm) == ""


def test_each_step_and_the_run_have_an_expected_time() -> None:
    log = capturing()
    earlier = {"fix_it": [60.0], "capture": TEN, "spray": [300.0], "scan": [300.0], "register": [1200.0]}
    said = [step_words(log.protocol, log.state, step, earlier) for step in log.protocol.steps]
    assert said[0] == "", "it is done"
    assert said[2] == "Usually takes 5 min (one earlier run on this site)."
    assert run_words(log.protocol, log.state, earlier, later(4)) == (
        "Work left: about 36 min, and the time for which the run waits for people."
    )
    del earlier["register"]
    assert run_words(log.protocol, log.state, earlier, later(4)).startswith(
        "Work left, of 3 of the 4 steps left: about 16 min"
    )
    assert run_words(log.protocol, log.state, {}, NOW) == ""
    log.act("abort", reason="enough")
    assert run_words(log.protocol, log.state, earlier, NOW) == ""


def test_a_pause_is_not_work() -> None:
    log = capturing()
    log.act("pause")
    log.late_s = 1800.0
    log.act("resume")
    words = work_words(log.protocol, log.state, {"capture": TEN}, later(34), hhmm)
    assert words == "Usually 10 min (3 earlier runs on this site); started at 00:00, so until about 00:40."
    words = work_words(log.protocol, log.state, {"capture": TEN}, later(47), hhmm)
    assert "It has worked for 17 min, and longer than ever before" in words
