"""The systematic crash sweep: the same short run, killed once at each point of its durable effects."""

from __future__ import annotations

import os
import shutil
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from random import Random
from typing import Literal

from bench.torture.crash.check import ROLES, Outcome, after_the_crash, at_the_end, of_a_beginning, outcome
from bench.torture.crash.power import lose_power
from bench.torture.crash.run import Place, Role, prepare, start
from service.store.store import Store
from tests.support.processes.mortal_files import Point, points, read_journal

How = Literal["kill", "power"]
_ALONE: dict[Role, str] = {"begin": "Ada", "web": "Sue"}  # processes that work alone, and who acts in them
_LONGEST_S = 300.0  # for a process of the run on a busy machine; the undisturbed run takes a few seconds
_POLL_S = 0.004


@dataclass(frozen=True, slots=True)
class Case:
    """One death: which process dies where, alone or by a power failure of the whole machine."""

    role: Role
    point: Point
    how: How
    again: Point | None = None  # where the resumed runner dies too


@dataclass(frozen=True, slots=True)
class Verdict:
    """The result of a case.

    Attributes:
        case: the case.
        reached: whether the process reached the point; a run of several processes varies.
        faults: violated conditions, as sentences.
        taken: what the loss of power removed.
        leftovers: number of files collected afterwards.
        seconds: total duration.
    """

    case: Case
    reached: bool
    faults: tuple[str, ...]
    taken: tuple[str, ...]
    leftovers: int
    seconds: float


class SweepError(Exception):
    """Even the undisturbed run has a fault."""


@dataclass
class Sweep:
    """A prepared run, its undisturbed outcome, and its points."""

    folder: Path
    seed: Place
    expected: Outcome
    completed: Place  # before its release
    points: dict[tuple[Role, How], list[Point]]
    numbered: int = field(default=0)

    @classmethod
    def begin(cls, folder: Path, *, remember: bool = True) -> Sweep:
        """Run twice undisturbed, to check that the results are bitwise equal.

        Raises SweepError if there is a fault even so.
        """
        seed = prepare(folder)
        seed = replace(seed, remember=remember)
        outcomes: list[Outcome] = []
        completed = seed
        for number in range(2):
            place = _copy(seed, folder / f"undisturbed-{number}")
            # The first run computes and caches all answers; the second computes them again.
            worker = start("worker", replace(place, remember=remember and number == 0))
            _ended(start("runner", place), place)
            _end({"worker": worker})
            completed = _copy(place, folder / f"completed-{number}")
            _ended(start("web", place, person="Sue"), place)
            faults, _ = at_the_end(place, None)
            if faults:
                raise SweepError(f"undisturbed: {faults}\n{place.said.read_text()}")
            with Store.open(place.data) as store:
                outcomes.append(outcome(store.events(store.find_run("latest"))))
        if outcomes[0] != outcomes[1]:
            raise SweepError("two undisturbed runs do not come to the same results")
        begun = Place(folder / "begun", seed.files)
        begun.folder.mkdir()
        _ended(start("begin", begun), begun)
        found: dict[tuple[Role, How], list[Point]] = {}
        for role in ROLES:
            journal = (begun if role == "begin" else replace(seed, folder=folder / "undisturbed-1")).journal(role)
            found[role, "kill"] = points(journal, power=False)
            found[role, "power"] = points(journal, power=True)
        return cls(folder, seed, outcomes[0], completed, found)

    def cases(self, ways: Sequence[How]) -> Iterator[Case]:
        """Yield every point of every process, in every way to die."""
        for how in ways:
            for role in ROLES:
                for point in self.points[role, how]:
                    yield Case(role, point, how)

    def try_case(self, case: Case, rng: Random) -> Verdict:
        """Run up to the point, die there, resume, confirm, complete the run and check it."""
        began_s = time.monotonic()
        self.numbered += 1
        place = self._place(case)
        faults: list[str] = []
        taken: list[str] = []
        collected = 0
        reached = False
        try:
            reached = self._die(case, place)
            if case.how == "power" and reached:
                taken = lose_power(place.data, [place.journal(role) for role in ROLES], rng)
            if reached:
                faults += after_the_crash(place)
            self._resume(case, place)
            late, collected = of_a_beginning(place) if case.role == "begin" else at_the_end(place, self.expected)
            faults += late
        except SweepError as error:
            faults.append(str(error))
        if not faults:
            shutil.rmtree(place.folder)  # folders of cases with faults are kept
        seconds = time.monotonic() - began_s
        return Verdict(case, reached, tuple(faults), tuple(taken), collected, seconds)

    def _place(self, case: Case) -> Place:
        """Copy the state in which the dying process starts, or begin a run if there is none."""
        folder = self.folder / f"case-{self.numbered}"
        if case.role == "begin":
            folder.mkdir()
            return replace(self.seed, folder=folder)
        return _copy(self.completed if case.role == "web" else self.seed, folder)

    def _die(self, case: Case, place: Place) -> bool:
        """Run until the process dies; returns whether it reached its point. No process is alive afterwards."""
        if case.role in _ALONE:
            status = _wait(start(case.role, place, die_at=case.point, person=_ALONE[case.role]))
            return os.WIFSIGNALED(status)
        alive: dict[Role, int] = {
            "worker": start("worker", place, die_at=case.point if case.role == "worker" else None),
            "runner": start("runner", place, die_at=case.point if case.role == "runner" else None),
        }
        try:
            victim = self._first_to_end(alive)
            died = _died(place, case.role)
            if victim == "worker" and case.how == "kill" and died:
                # As the pool does after a child died: replace it, and the runner continues.
                alive["worker"] = start("worker", place)
                if self._first_to_end(alive) != "runner":
                    raise SweepError(f"the second worker ended: {_tail(place)}")
            elif not died and victim != "runner":
                raise SweepError(f"the {victim} ended: {_tail(place)}")
        finally:
            _end(alive)
        return died

    def _first_to_end(self, alive: dict[Role, int]) -> Role:
        deadline_s = time.monotonic() + _LONGEST_S
        while time.monotonic() < deadline_s:
            for role, pid in alive.items():
                ended, status = os.waitpid(pid, os.WNOHANG)
                if ended:
                    del alive[role]
                    if os.WIFEXITED(status) and os.WEXITSTATUS(status):
                        raise SweepError(f"an exception in the {role}")
                    return role
            time.sleep(_POLL_S)
        raise SweepError(f"{' and '.join(alive)} did not end within {_LONGEST_S:.0f} s")

    def _resume(self, case: Case, place: Place) -> None:
        """Start a new runner and worker, with another person who confirms; then release the run."""
        if case.role == "begin":
            _ended(start("begin", place), place)
            return
        if case.again is not None:
            alive: dict[Role, int] = {
                "worker": start("worker", place),
                "runner": start("runner", place, die_at=case.again, person="Grace"),
            }
            try:
                self._first_to_end(alive)
            finally:
                _end(alive)
        worker = start("worker", place)
        try:
            _ended(start("runner", place, person="Grace"), place)
        finally:
            _end({"worker": worker})
        _ended(start("web", place, person="Sue"), place)


def _copy(place: Place, folder: Path) -> Place:
    shutil.copytree(place.folder, folder, copy_function=shutil.copy2)
    return replace(place, folder=folder)


def _died(place: Place, role: Role) -> bool:
    return any(line.get("died") for line in read_journal(place.journal(role)))


def _wait(pid: int) -> int:
    """Wait for a process and return its status. Raises SweepError, after ending it, if it takes too long."""
    deadline_s = time.monotonic() + _LONGEST_S
    while time.monotonic() < deadline_s:
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            return status
        time.sleep(_POLL_S)
    _end({"runner": pid})
    raise SweepError(f"a process did not end within {_LONGEST_S:.0f} s")


def _ended(pid: int, place: Place) -> None:
    """Wait for a process that must finish its work. Raises SweepError if it fails."""
    status = _wait(pid)
    if status:
        raise SweepError(f"a process ended with {status}: {_tail(place)}")


def _end(alive: dict[Role, int]) -> None:
    for pid in alive.values():
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        with suppress(ChildProcessError):
            os.waitpid(pid, 0)
    alive.clear()


def _tail(place: Place) -> str:
    return place.said.read_text()[-1500:] if place.said.exists() else ""
