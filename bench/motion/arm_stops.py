"""Speed, acceleration and watchdog × every arm: what is allowed, and how soon a simulated arm stands then.

`python -m bench.motion.arm_stops`. First the rule that `protocol check` and the first motion ask judges a grid for
every known arm. Then every arm that a simulated controller can be moves at the largest speed that is allowed, its
driver's process is killed, and the controller's own record says when the arm stood. The controller's guard is slowed
down by a known time, so that a busy machine does not set it off before; that time is taken off what is measured.
"""

from __future__ import annotations

import argparse
import itertools
import json
import signal
import sys
import time
from collections import Counter
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise

from pydantic import BaseModel

from bench.machine import RESULTS, commit, machine
from drivers.interfaces import Abandoned
from drivers.kuka import KukaConfig
from drivers.ur import UrConfig
from service.core.arms import ArmModel, known_arms
from service.core.protocol import Motion, motion_problems
from simulators.kuka_controller.kinematics import MODELS as LBRS
from simulators.ur_controller.kinematics import MODELS as URS
from tests.support.arms.arm_watch import watched_arm
from tests.support.arms.kuka_simulator import simulated_kuka
from tests.support.arms.stubborn import Program
from tests.support.arms.ur_simulator import address, simulated_ur
from tests.support.processes.lateness import Lateness
from tests.support.rig.world_watch import watched_world

SPEEDS_RAD_S = (0.1, 0.25, 0.5, 1.0, 1.2, 1.4, 2.0, 2.2, 3.1, 1000.0)
ACCELERATIONS_RAD_S2 = (0.5, 1.5, 15.0, 40.0, 1000.0)
WATCHDOGS_S = (0.1, 0.2, 0.3, 0.5, 1.0)
RESTS_S = (0.2, 0.45, 0.55, 1.0, 2.0)
_SLOWED_S = 1.5  # the controller's guard waits so long in the second part
_ACCELERATION_RAD_S2 = 10.0
_GOALS_RAD = (2.9, -2.9)
# Longest gap between two messages in which a simulated controller was scheduled: its longest cycle that counts in
# full when it waits (simulators/ur_controller, simulators/kuka_controller), and the time between messages.
_UR_UNSCHEDULED_S, _KUKA_UNSCHEDULED_S = 0.02 + 0.008, 0.1 + 0.016
_OWN_SPEED_REST_S = 5.0  # so generous that only the arm's own speed limits the motion
_LATE, _TRIES = "**LATE**", 4
_LATE_TIMES = 5  # driver, program, their threads and the controller wake one after the other


@dataclass(frozen=True, slots=True)
class Allowed:
    """Holds what the rule says of the grid for one arm: how many combinations it allows, and what it refuses."""

    arm: str
    allowed: int
    refused: dict[str, int]  # by the fields that are named
    contradicts: int  # allowed although the arm would rest too late or is too slow, or the other way round


@dataclass(frozen=True, slots=True)
class Stop:
    """One arm whose driver was killed.

    Attributes:
        arm: its name.
        how: the signal that the driver's process was sent.
        speed_rad_s: at which it moved: the largest allowed.
        noticed_after_s: until the controller ends the motion.
        rest_within_s: allowed; where only the arm's own speed limits it, what the rule predicts.
        by_guard: whether the controller's guard ended the motion; if not, the end of the connection did.
        measured_s: from the signal until the arm was last driven; what the guard was slowed by is taken off.
        late_s: by how much a thread of this machine woke too late meanwhile, at worst.
        tries: after an arm that was late another try is made, as a busy machine may be the reason.
    """

    arm: str
    how: str
    speed_rad_s: float
    noticed_after_s: float
    rest_within_s: float
    by_guard: bool
    measured_s: float
    late_s: float
    tries: int = 1

    @property
    def verdict(self) -> str:
        """Return whether it stands within the time that is allowed, or would but for the lateness of this machine."""
        if self.measured_s <= self.rest_within_s:
            return "in time"
        late = self.measured_s > self.rest_within_s + _LATE_TIMES * self.late_s
        return _LATE if late else "in time but for this machine's lateness"


@dataclass(frozen=True, slots=True)
class Step:
    """A message of a controller: when it came (host time.monotonic()), its own time, the speed of the arm then."""

    at_s: float
    time_s: float
    speed_rad_s: float


def refused(arm: ArmModel, speed_rad_s: float, acceleration_rad_s2: float, abandoned: Abandoned) -> tuple[str, ...]:
    """The fields that the rule names for this motion."""
    motion = Motion(speed_rad_s=speed_rad_s, acceleration_rad_s2=acceleration_rad_s2)
    return tuple(sorted({field for field, _ in motion_problems(motion, [arm], abandoned)}))


def judge(arm: ArmModel) -> Allowed:
    """Ask the rule about the whole grid, and compare with the arm's figures themselves."""
    fields: Counter[str] = Counter()
    allowed = contradicts = 0
    for speed, acceleration, watchdog, rest in itertools.product(
        SPEEDS_RAD_S, ACCELERATIONS_RAD_S2, WATCHDOGS_S, RESTS_S
    ):
        named = refused(arm, speed, acceleration, Abandoned(watchdog, rest))
        fields[" and ".join(named)] += bool(named)
        allowed += not named
        stands = watchdog + speed / arm.braking_rad_s2 <= rest + 1e-6
        can = speed <= float(arm.speeds_rad_s.min()) and acceleration <= arm.acceleration_rad_s2
        contradicts += (stands and can) != (not named)
    return Allowed(arm.name, allowed, {name: count for name, count in fields.items() if count}, contradicts)


def largest_speed_rad_s(arm: ArmModel, abandoned: Abandoned) -> float:
    """The largest speed that the rule allows, to a micrometre a second at a metre; 0 if it allows none."""
    low, high = 0.0, 100.0
    while high - low > 1e-6:
        middle = (low + high) / 2
        low, high = (low, middle) if refused(arm, middle, _ACCELERATION_RAD_S2, abandoned) else (middle, high)
    return low


# --- simulated arms --------------------------------------------------------------------------------------------


@contextmanager
def _moving(config: BaseModel, spec: str, speed_rad_s: float) -> Generator[Program]:
    program = Program(spec, config, _GOALS_RAD, motion=(speed_rad_s, _ACCELERATION_RAD_S2))
    try:
        program.next("error")  # nobody has let it move
        program.let_move("Ada")
        program.next("moves_to")
        yield program
    finally:
        program.close()


def moved_on_s(steps: Sequence[Step], since_s: float, unscheduled_s: float) -> float:
    """Time from a moment of the host until the arm was last driven, on the controller's clock.

    The message that came soonest tells what that clock showed then. A simulated controller that was not scheduled
    takes no cycle for longer than usual when it waits for its client (a real one keeps its cycle): what a gap between
    two messages is longer than `unscheduled_s` is left out until the arm brakes.
    """
    kill_s = since_s + max(one.time_s - one.at_s for one in steps)
    after = [(new.time_s - max(old.time_s, kill_s), new) for old, new in pairwise(steps) if new.time_s > kill_s]
    full_rad_s = 0.98 * max(one.speed_rad_s for _, one in after)
    lost_s = sum(max(0.0, gap_s - unscheduled_s) for gap_s, one in after if one.speed_rad_s >= full_rad_s)
    return max(one.time_s for _, one in after if one.speed_rad_s > 0.0) - kill_s - lost_s


def measure_ur(config: UrConfig, model: str, speed_rad_s: float, how: signal.Signals) -> tuple[float, float]:
    """End or suspend the driver of a moving arm; for how long that moved on, and this machine's worst lateness, s."""
    words = ("--model", model, f"--initial-joints={_GOALS_RAD[1]},-1.6,1.9,-1.9,-1.57,0")
    with (
        simulated_ur(config.host, *words, patience_s=_SLOWED_S),
        watched_arm(config.host) as arm,
        _moving(config, "drivers.ur:DRIVER", speed_rad_s) as program,
        Lateness() as lateness,
    ):
        arm.wait_moving(0.99 * speed_rad_s)
        since, since_s = arm.mark(), time.monotonic()
        program.send(("driver", how))
        arm.wait_stopped(since)
        steps = [Step(one.at_s, one.time_s, one.speed_rad_s) for one in arm.samples()]
        return moved_on_s(steps, since_s, _UR_UNSCHEDULED_S), lateness.worst_s


def measure_kuka(config: KukaConfig, model: str, speed_rad_s: float, how: signal.Signals) -> tuple[float, float]:
    """The same for an arm of KUKA, whose joints the simulated world is told."""
    with watched_world() as watch:
        words = (
            "--model",
            model,
            "--world",
            watch.address,
            f"--initial-joints={_GOALS_RAD[1]},0.5,0,-1.4,0,1.2,-1.57",
        )
        with (
            simulated_kuka(config.host, *words, patience_s=_SLOWED_S),
            _moving(config, "drivers.kuka:DRIVER", speed_rad_s) as program,
            Lateness() as lateness,
        ):
            watch.wait_moving(watch.mark(), speed_rad_s / _ACCELERATION_RAD_S2 + 0.1)
            since_s = watch.mark()
            program.send(("driver", how))
            watch.wait_resting(since_s)
            told = watch.joints()
        steps = [
            Step(new.at_s, new.time_s, abs(new.joints_rad[0] - old.joints_rad[0]) / (new.time_s - old.time_s))
            for old, new in pairwise(told)
            if new.time_s > old.time_s
        ]
        return moved_on_s(steps, since_s, _KUKA_UNSCHEDULED_S), lateness.worst_s


def stop(arm: ArmModel, number: int, how: signal.Signals, *, own_speed: bool) -> Stop:
    """End or suspend the driver of an arm at the largest speed of the usual rig file, or at the arm's own largest."""
    limits = {"rest_within_s": _OWN_SPEED_REST_S} if own_speed else {}
    host = address(number)
    kind = UrConfig if arm.name in URS else KukaConfig
    config = kind.model_validate({"host": host, **limits})
    abandoned = config.abandoned
    speed = largest_speed_rad_s(arm, abandoned)
    if isinstance(config, UrConfig):
        moved_s, late_s = measure_ur(config, arm.name, speed, how)
    else:
        moved_s, late_s = measure_kuka(config, arm.name, speed, how)
    predicted_s = abandoned.noticed_after_s + speed / arm.braking_rad_s2
    rest_s = predicted_s if own_speed else abandoned.rest_within_s
    by_guard = moved_s > _SLOWED_S
    measured_s = moved_s - (_SLOWED_S - abandoned.noticed_after_s) if by_guard else moved_s
    return Stop(arm.name, how.name, speed, abandoned.noticed_after_s, rest_s, by_guard, measured_s, late_s)


# --- results -----------------------------------------------------------------------------------------------------


def _speeds(arms: Sequence[ArmModel], rest_s: float) -> list[str]:
    head = " | ".join(f"watchdog {watchdog:g} s" for watchdog in WATCHDOGS_S)
    rows = [f"| arm | {head} |", "|---|" + "---:|" * len(WATCHDOGS_S)]
    for arm in arms:
        speeds = (largest_speed_rad_s(arm, Abandoned(watchdog, rest_s)) for watchdog in WATCHDOGS_S)
        rows.append(f"| {arm.name} | {' | '.join(f'{speed:.2f}' if speed > 1e-3 else 'none' for speed in speeds)} |")
    return rows


def report(
    arms: Sequence[ArmModel], judged: Sequence[Allowed], stops: Sequence[Stop], today: str, revision: str
) -> str:
    """All results in Markdown."""
    braking = ", ".join(f"{value:g}" for value in sorted({arm.braking_rad_s2 for arm in arms}))
    combinations = len(SPEEDS_RAD_S) * len(ACCELERATIONS_RAD_S2) * len(WATCHDOGS_S) * len(RESTS_S)
    lines = [
        f"# How fast arms may move, and how soon they stand, {today}", "",
        f"`python -m bench.motion.arm_stops`, revision {revision}. Assumed for every arm: a controller that ends a "
        f"motion brakes with {braking} rad/s². No data sheet says so; it has to be measured on the arm "
        "(docs/howto/your_hardware.md). The simulated controllers brake with 4 rad/s² (UR) and 6 rad/s² (LBR).", "",
        f"## What the rule says of {combinations} combinations", "",
        f"Speeds {SPEEDS_RAD_S} rad/s, accelerations {ACCELERATIONS_RAD_S2} rad/s², watchdogs {WATCHDOGS_S} s, "
        f"rest_within_s {RESTS_S} s.", "",
        "| arm | allowed | refused | for | contradicts the arm's figures |", "|---|---:|---:|---|---:|",
        *[
            f"| {one.arm} | {one.allowed} | {sum(one.refused.values())} | "
            f"{', '.join(f'{name}: {count}' for name, count in sorted(one.refused.items()))} | {one.contradicts} |"
            for one in judged
        ],
    ]  # fmt: skip
    for rest_s in RESTS_S:
        lines += ["", f"Largest speed in rad/s with rest_within_s = {rest_s:g} s:", "", *_speeds(arms, rest_s)]
    lines += [
        "", "## Killed at the largest speed", "",
        "The driver's process is killed (SIGKILL), or suspended (SIGSTOP), while the arm moves. The controllers are "
        f"simulated, and their guard was slowed down to {_SLOWED_S:g} s. `measured` is from the signal until the "
        "arm was last driven; where the guard ended the motion, that time is taken off and the real guard put in its "
        "place. The first rows use the usual limits of a rig file; the last ones move as fast as the arm can, and "
        "must stand when the rule predicts it.", "",
        "| arm | signal | rad/s | noticed after | must rest within | ended by | measured | late here | tries | |",
        "|---|---|---:|---:|---:|---|---:|---:|---:|---|",
        *[
            f"| {one.arm} | {one.how} | {one.speed_rad_s:.2f} | {one.noticed_after_s:g} s | "
            f"{one.rest_within_s:.3f} s | {'guard' if one.by_guard else 'connection'} | {one.measured_s:.3f} s | "
            f"{one.late_s:.3f} s | {one.tries} | {one.verdict} |"
            for one in stops
        ], "",
        f"This machine's lateness counts {_LATE_TIMES} times: driver, program, their threads and the controller wake "
        f"one after the other. An arm that is not in time is tried again, {_TRIES} tries at most; the last counts.",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def main() -> None:
    """Judge, kill, print, and record if asked. Ends with 1 if an arm rests too late or the rule contradicts it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--arms", nargs="*", help="names of arms that are killed; all by default")
    parser.add_argument("--record", action="store_true", help="write the results to bench/results")
    options = parser.parse_args()
    arms, revision = known_arms(), commit()
    judged = [judge(arm) for arm in arms]
    tried = [arm for arm in arms if arm.name in {*URS, *LBRS} and options.arms in (None, [arm.name])]
    stops: list[Stop] = []
    cases = ((signal.SIGKILL, False), (signal.SIGSTOP, False), (signal.SIGKILL, True))
    for (how, own_speed), (number, arm) in itertools.product(cases, enumerate(tried)):
        found, tries = stop(arm, 100 + number, how, own_speed=own_speed), 1
        while found.verdict != "in time" and tries < _TRIES:
            tries += 1
            found = replace(stop(arm, 100 + number, how, own_speed=own_speed), tries=tries)
        stops.append(found)
        print(found, flush=True)
    today = datetime.now(UTC).date().isoformat()
    text = report(arms, judged, stops, today, revision)
    if options.record:
        rows = {"judged": [asdict(one) for one in judged], "stops": [asdict(one) for one in stops]}
        (RESULTS / f"arm_stops-{today}.json").write_text(
            json.dumps({"commit": revision, "machine": machine(), **rows}, indent=1) + "\n"
        )
        (RESULTS / f"arm_stops-{today}.md").write_text(text)
    print(text)
    if any(one.verdict == _LATE for one in stops) or any(one.contradicts for one in judged):
        sys.exit("an arm rests too late, or the rule contradicts the arm's figures")


if __name__ == "__main__":
    main()
