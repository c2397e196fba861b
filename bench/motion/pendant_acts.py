"""Does at the pendant what people do, at each moment of a capture (`python -m bench.motion.pendant_acts`).

A run captures three views with the real driver on a simulated controller. Once, at the second view, somebody pushes
the arm, guides it in free drive, changes tool centre point or payload, moves the speed slider, or starts another
program. Whoever is asked confirms (and sets the slider back). Of each run it says what became of the act, after how
long, and how far the recorded pose of every view that counts is from where the arm was: by the joints that another
connection saw, and the arm's kinematics.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from bench.machine import RESULTS, commit, machine
from service.core.arms import arm_model, flange_pose, pose_gap
from service.core.records.run_events import OperatorAction, StepFailed, ViewpointCaptured
from service.core.run.decide import AskOperator
from service.core.run.state import RunState
from service.core.units import deg, mm
from service.store.store import Store
from service.store.verification.verify import verify
from tests.support.arms.arm_watch import ArmWatch
from tests.support.arms.ur_simulator import pendant
from tests.support.rig.bench_rig import answer
from tests.support.runs.one_arm_run import VIEWS, OneArmRun, arm_at

ACTS = {
    "program": "program other.urp",
    "push": "push 0 0 0.05 0 0 0 0.1",
    "slight push": "push 0 0 0.004 0 0 0 0.1",
    "free drive": "freedrive 0 0 0.05 0 0 0 0.1",
    "TCP by 100 mm": "tcp 0 0 0.1 0 0 0",
    "TCP by 1 mm": "tcp 0.001 0 0 0 0 0",
    "payload": "payload 3 0 0 0.08",
    "slider to 30 %": "slider 30",
    "slider to 0 %": "slider 0",
}
MOMENTS = ("before motion", "in motion", "settling", "exposing", "between views")
WRONG_M, WRONG_RAD = 0.0001, 0.0002  # a tenth of a millimetre: more than standing still allows
_SLIDER_BACK_S = 5.0
_LOOK_S = 0.002
_DONE_S = 0.2  # of the controller's time, in which every act is over


@dataclass(frozen=True, slots=True)
class Outcome:
    """Holds what became of one act at one moment."""

    act: str
    moment: str
    done: bool  # whether the moment came
    status: str  # of the run
    noticed: str  # errors that stopped the step, then images taken again; "" if neither
    after_s: float | None  # from the act to the first of them
    asked: int  # questions to a person
    images: int  # recorded, those taken again included
    worst_mm: float  # pose of a view that counts, from where the arm was
    worst_deg: float
    wrong: int  # images that count with a wrong pose
    other_tool: int  # images that count whose recorded tool is not the rig's
    verifies: bool


class Act:
    """Does one act, once, at its moment."""

    def __init__(self, run: OneArmRun, arm: ArmWatch, host: str, act: str, moment: str) -> None:
        self._run, self._arm, self._host = run, arm, host
        self._act, self._moment = act, moment
        self.done_s: float | None = None  # host time.monotonic()
        shutter = run.station.shutter
        shutter.on_capture = lambda number: self._at("exposing") if number == 2 else None
        run.station.on_robot = self._take
        run.operator.on_show = self._show
        self._ended = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def end(self) -> None:
        """Leave the pendant."""
        self._ended.set()

    def _at(self, moment: str) -> None:
        if self.done_s is None and moment == self._moment:
            pendant(self._host, ACTS[self._act])
            self.done_s = time.monotonic()

    def _take(self) -> None:
        """Called when the arm is about to be sent to a view."""
        if self._run.station.shutter.exposures == 1:
            self._at("before motion")
            self._arm.pass_s(_DONE_S)

    def _show(self, what: str) -> None:
        """Called after a view, its image still in memory."""
        if what == "viewpoints" and self._run.station.shutter.exposures == 1:
            self._at("between views")
            self._arm.pass_s(_DONE_S)

    def _watch(self) -> None:
        """Look at the arm, and at the slider, which is set back from 0 by somebody who wonders why nothing moves."""
        moved = False
        while not self._ended.wait(_LOOK_S):
            if self._run.station.shutter.exposures == 1:
                speed = self._arm.now.speed_rad_s
                if speed > 0.2:
                    self._at("in motion")
                elif moved and speed == 0.0:
                    self._at("settling")
                moved = moved or speed > 0.2
            late = self.done_s is not None and time.monotonic() - self.done_s > _SLIDER_BACK_S
            if self._act == "slider to 0 %" and late:
                pendant(self._host, "slider 100")
                self._act = ""


def sweep_one(act: str, moment: str, number: int) -> Outcome:
    """One run with one act."""
    with (
        tempfile.TemporaryDirectory() as folder,
        arm_at(number) as (host, arm),
        Store.open(Path(folder) / "data") as store,
    ):
        run = OneArmRun(store, Path(folder), host, arm)
        doing = Act(run, arm, host, act, moment)
        asked: list[str] = []

        def confirm(question: AskOperator, _state: RunState) -> OperatorAction:
            asked.append(question.text)
            if "another program runs" in question.text:
                pendant(host, "stop")  # as the question says
            return answer(question, "confirm")

        run.answers(*[confirm] * 4)
        status = run.drive().status
        doing.end()
        events = store.events(run.run_id)
        failed = [(e.monotonic_s, e.payload.error) for e in events if isinstance(e.payload, StepFailed)]
        moved = [
            (e.monotonic_s, "image taken again")
            for e in events
            if isinstance(e.payload, ViewpointCaptured) and not all(e.payload.verdicts.values())
        ]
        noticed = sorted(failed + moved)
        views = run.views()
        away = {view.viewpoint: _away(view, arm) for view in views}  # the newest of each counts
        newest = {view.viewpoint: view for view in views}
        since_s = None if not noticed or doing.done_s is None else noticed[0][0] - doing.done_s
        report = verify(Path(folder) / "data", run.run_id)
    return Outcome(
        act=act,
        moment=moment,
        done=doing.done_s is not None,
        status=status if sorted(newest) == VIEWS else f"{status}, {len(newest)} views",
        noticed=", ".join(dict.fromkeys(name for _, name in [*sorted(failed), *moved])),
        after_s=since_s,
        asked=len(asked),
        images=len(views),
        worst_mm=mm(max((m for m, _ in away.values()), default=0.0)),
        worst_deg=deg(max((rad for _, rad in away.values()), default=0.0)),
        wrong=sum(m > WRONG_M or rad > WRONG_RAD for m, rad in away.values()),
        other_tool=sum(not _has_rigs_tool(view) for view in newest.values()),
        verifies=report.ok,
    )


def _away(view: ViewpointCaptured, arm: ArmWatch) -> tuple[float, float]:
    """How far the recorded pose is from the arm's at that moment, m and rad."""
    was = flange_pose(arm_model("UR10e"), np.array(arm.joints_at(view.controller_time_s)))
    return pose_gap(was, np.array(view.T_base_flange))


def _has_rigs_tool(view: ViewpointCaptured) -> bool:
    return view.payload_kg == 1.6 and np.allclose(view.T_flange_tcp or np.zeros((4, 4)), np.eye(4), atol=1e-6)


def table(outcomes: Sequence[Outcome]) -> list[str]:
    """The rows of the table of results."""
    return [
        f"| {o.act} | {o.moment} | {o.noticed or 'nothing'} | {'' if o.after_s is None else f'{o.after_s:.2f}'} | "
        f"{o.asked} | {o.images} | {o.worst_mm:.3f} | {o.wrong} | {o.other_tool} | {o.status}"
        f"{'' if o.verifies else ', does not verify'}{'' if o.done else ', the moment did not come'} |"
        for o in outcomes
    ]


def text(outcomes: Sequence[Outcome], today: str, measured: str) -> str:
    """The results as a page."""
    wrong, images = sum(o.wrong for o in outcomes), sum(o.images for o in outcomes)
    return "\n".join([
        f"# What acts at the pendant do to a capture, {today}", "",
        f"`python -m bench.motion.pendant_acts`, revision {measured}. Three views; the act once, at the second one. "
        "*After*: from the act to the event that names it, when the arm was opened anew (push) or has stopped. "
        "*Worst*: pose of a view that counts, from where the arm was. *Wrong*: images that count with a pose that is "
        f"off by more than {mm(WRONG_M):g} mm or {deg(WRONG_RAD):.2g}°. *Other tool*: images that count while the "
        "controller held another tool or payload than the rig's. A slight push ends within the 5 mrad that count as "
        "arrived; where the speed slider stands, the page says beside the robot's state.", "",
        "| act | moment | noticed as | after, s | asked | images | worst, mm | wrong | other tool | run |",
        "|---|---|---|---:|---:|---:|---:|---:|---:|---|", *table(outcomes), "",
        f"Images with a wrong pose: {wrong} of {images}.",
    ]) + "\n"  # fmt: skip


def main() -> None:
    """Sweep, print, and record if asked, after each run: a sweep that is cut short has told what it found."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--act", choices=tuple(ACTS), action="append", help="only this one; may be repeated")
    parser.add_argument("--moment", choices=MOMENTS, action="append", help="only this one; may be repeated")
    parser.add_argument("--record", action="store_true", help="write the results to bench/results")
    options = parser.parse_args()
    outcomes: list[Outcome] = []
    today = datetime.now(UTC).date().isoformat()
    measured = commit()
    for act in options.act or ACTS:
        for moment in options.moment or MOMENTS:
            outcomes.append(sweep_one(act, moment, 1 + len(outcomes)))
            print(*table(outcomes[-1:]), flush=True)
            if options.record:
                data = {"commit": measured, "machine": machine(), "outcomes": [asdict(o) for o in outcomes]}
                (RESULTS / f"pendant_acts-{today}.json").write_text(json.dumps(data, indent=1) + "\n")
                (RESULTS / f"pendant_acts-{today}.md").write_text(text(outcomes, today, measured))
    print(text(outcomes, today, measured))


if __name__ == "__main__":
    main()
