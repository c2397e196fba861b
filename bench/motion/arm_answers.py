"""Every answer that the UR driver asks for × every way in which it can be wrong: what the driver says, and how soon.

`python -m bench.motion.arm_answers`. A simulated controller spoils one answer of its dashboard, or one field of its
RTDE stream, from the start or in the middle of the work. The driver opens the arm, reports, moves and stops; each
call must end, in its answer or in an error with words. Then a sound controller stands at the same address, and the
same driver must work with it.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from typing import Any

from bench.machine import RESULTS, commit, machine
from drivers.errors import DeviceError
from drivers.host.hosted_device import hosted
from drivers.interfaces import RobotArm
from drivers.ur import UrConfig
from drivers.ur.samples import VARIABLES
from simulators.ur_controller.dashboard import REFUSED
from tests.support.arms.ur_driver import let_move, move, turned
from tests.support.arms.ur_simulator import simulated_ur
from tests.support.rig.patience import PATIENT_UR

ANSWER_S, CALL_S = 2.0, 45.0  # within which a dashboard must answer, and within which a call must end
_LATE_S = 1000.0
_MIDDLE = 500  # data packages of a client until a field is spoilt in the middle of the work
_REST_S = 5.0  # so that the middle has passed before the motion
QUESTIONS = {
    "polyscopeversion": "PolyScope X",
    "get serial number": "could not understand: 'get serial number'",
    "get robot model": "could not understand: 'get robot model'",
    "is in remote control": "could not understand: 'is in remote control'",
    "stop": "Failed to execute: stop",
}


#: Fields of which nobody can tell that they are frozen, since they may rest for hours in a sound arm.
MAY_REST = {
    "target_qd": "at zero, as of an arm that a hand turns; frozen while the arm is driven, it is seen",
    "safety_status_bits": "normal for a whole day; what stops an arm also ends the control script, which is seen",
    "robot_mode": "RUNNING for a whole day; an arm without power also ends the control script",
    "runtime_state": "PLAYING as long as the control script runs, which another connection tells",
    "target_speed_fraction": "the slider stays where it is; another speed only lasts longer",
    "payload": "set once a run",
    "payload_cog": "set once a run",
}


@dataclass(frozen=True, slots=True)
class Case:
    """One answer and what is wrong with it."""

    answer: str
    wrong: str
    fault: dict[str, Any]


@dataclass(slots=True)
class Outcome:
    """Holds what the driver did: each call's end, the longest call, and whether it works with a sound controller."""

    answer: str
    wrong: str
    calls: dict[str, str] = field(default_factory=dict)
    longest_s: float = 0.0
    longest: str = ""
    works_again: bool = False

    @property
    def words(self) -> str:
        """The first error, or that everything worked."""
        failed = [f"{call}: {said}" for call, said in self.calls.items() if said != "done"]
        return failed[0] if failed else "works"


def cases() -> Iterator[Case]:
    """Every question and every field, with every fault."""
    for question, other in QUESTIONS.items():
        on = f"dashboard {question}"
        for wrong, fault in (
            ("refused", {"kind": "say", "value": REFUSED}),
            ("other words", {"kind": "say", "value": other}),
            ("never", {"kind": "stall", "value": _LATE_S}),
            ("connection closed", {"kind": "drop"}),
        ):
            yield Case(f"`{question}`", wrong, {"on": on, "times": 1000, **fault})
    for name in VARIABLES:
        for wrong, fault in (
            ("absent", {"kind": "absent"}),
            ("no number from the start", {"kind": "nan"}),
            ("no number in the middle", {"kind": "nan", "nth": _MIDDLE}),
            ("frozen in the middle", {"kind": "freeze", "nth": _MIDDLE}),
        ):
            yield Case(name, wrong, {"on": f"field {name}", **fault})


def tried(case: Case, host: str) -> Outcome:
    """Work with an arm whose controller answers so, then with one that is sound."""
    outcome = Outcome(case.answer, case.wrong)
    section = UrConfig.model_validate(
        {"host": host, **PATIENT_UR, "connect_timeout_s": ANSWER_S, "stale_after_s": 2.0}
    )
    arm = hosted(RobotArm, "drivers.ur:DRIVER", section, call_timeout_s=CALL_S, name="robot")
    plan = json.dumps([{"device": "robot", **case.fault}])
    try:
        with simulated_ur(host, "--speed-up", "3", "--faults", plan):
            _work(arm, outcome)
        with simulated_ur(host, "--speed-up", "3"):
            again = Outcome(case.answer, case.wrong)
            _work(arm, again, rest_s=0.0)
            outcome.works_again = again.words == "works"
            if not outcome.works_again:
                outcome.calls["again"] = again.words
    finally:
        arm.close()
    return outcome


def _work(arm: RobotArm, outcome: Outcome, rest_s: float = _REST_S) -> None:
    def call(name: str, act: Callable[[], object]) -> None:
        began_s = time.monotonic()
        try:
            act()
            outcome.calls[name] = "done"
        except DeviceError as error:
            outcome.calls[name] = f"{type(error).__name__}: {error}"
        took_s = time.monotonic() - began_s
        if took_s > outcome.longest_s and name != "the motion's end":
            outcome.longest_s, outcome.longest = took_s, name

    def ended() -> None:
        while arm.is_moving():
            time.sleep(0.05)

    call("open", arm.open)
    call("report", arm.report)
    call("let_move", lambda: let_move(arm))
    time.sleep(rest_s)
    call("move", lambda: move(arm, turned(arm, 0.1)))
    call("the motion's end", ended)
    call("state", arm.state)
    call("stop", arm.stop)


def as_markdown(record: dict[str, Any]) -> str:
    """Format the record as Markdown."""
    rows = record["rows"]
    again = sum(row["works_again"] for row in rows)
    longest = max(row["longest_s"] for row in rows)
    lines = [
        f"# Every answer of a UR controller, spoilt in every way, {record['date']}",
        "",
        f"Commit {record['commit']}. {len(rows)} cases; in {again} of them the same driver works with a sound "
        f"controller afterwards, without being started again. The longest call took {longest:.1f} s; a dashboard has "
        f"{ANSWER_S:g} s to answer, a call {CALL_S:g} s.",
        "",
        "| answer | what is wrong | what the driver says first | longest call | works again |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        words = row["words"].replace("|", "/").replace("\n", " ")
        lines.append(
            f"| {row['answer']} | {row['wrong']} | {words} | {row['longest']}, {row['longest_s']:.1f} s | "
            f"{'yes' if row['works_again'] else '**no**: ' + row['calls'].get('again', '')} |"
        )
    lines += ["", "What may rest in a sound arm, so that a frozen field is not told from a sound one:", ""]
    lines += [f"- {field}: {why}." for field, why in record["may_rest"].items()]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure, print and write both result files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="cases whose answer or fault has these words")
    parser.add_argument("--date", default=datetime.now(tz=UTC).date().isoformat())
    options = parser.parse_args()
    chosen = [case for case in cases() if options.only in f"{case.answer} {case.wrong}"]
    rows: list[dict[str, Any]] = []
    with ThreadPoolExecutor(3) as pool:
        hosts = [f"127.7.99.{10 + number}" for number in range(len(chosen))]
        for outcome in pool.map(tried, chosen, hosts):
            rows.append({**asdict(outcome), "words": outcome.words})
            print(json.dumps(rows[-1]), flush=True)
    record = {"date": options.date, "commit": commit(), "machine": machine(), "rows": rows, "may_rest": MAY_REST}
    if options.only:
        print(as_markdown(record))
        return
    stem = RESULTS / f"arm_answers-{options.date}"
    stem.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    stem.with_suffix(".md").write_text(as_markdown(record), encoding="utf-8")


if __name__ == "__main__":
    main()
