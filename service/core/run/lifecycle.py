"""The lifecycle of a run: a table of states and transitions generated from the protocol's steps.

This is the only module that imports `transitions`. The hierarchical machine is built from data, checked by the
library, and flattened once into the pure function (state, trigger) → state that the fold uses.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

from transitions.extensions.nesting import HierarchicalMachine, NestedState

from service.core.errors import IllegalTransitionError

Phase = Literal["ready", "running", "checking", "awaiting_operator", "recovering", "passed"]
PHASES: tuple[Phase, ...] = ("ready", "running", "checking", "awaiting_operator", "recovering", "passed")
SEPARATOR = "."  # step identifiers contain underscores
PAUSED, COMPLETED, ABORTED = "paused", "completed", "aborted"
RESERVED_STEP_IDS = frozenset({PAUSED, COMPLETED, ABORTED})


class Rule(NamedTuple):
    """One row of the table within a step: `trigger` leads from `source` to `target`."""

    trigger: str
    source: Phase
    target: Phase


# The rules within every step. `advance`, `redo`, `pause`, `resume` and `abort` lead out of a step; added below.
STEP_RULES: tuple[Rule, ...] = (
    Rule("begin", "ready", "running"),
    Rule("measured", "running", "checking"),
    Rule("failed", "running", "recovering"),
    Rule("gates_passed", "checking", "awaiting_operator"),
    Rule("gates_failed", "checking", "recovering"),
    Rule("gates_accepted", "recovering", "awaiting_operator"),
    Rule("accept", "awaiting_operator", "passed"),
    Rule("retry", "recovering", "running"),
    Rule("skip", "ready", "passed"),
    Rule("skip", "recovering", "passed"),
    Rule("skip", "awaiting_operator", "passed"),
)


@dataclass(frozen=True)
class MachineState:
    """A state of the machine by its parts: step, phase, and whether paused."""

    step: str
    phase: Phase
    paused: bool


def redo(step: str) -> str:
    """Return the name of the trigger that leads back to `step`."""
    return f"redo_{step}"


def state_name(step: str, phase: Phase, *, paused: bool = False) -> str:
    """Return the machine's name for a state, such as `calibration.ready` or `paused.calibration.ready`."""
    return SEPARATOR.join((*((PAUSED,) if paused else ()), step, phase))


class Lifecycle:
    """The compiled table of one protocol."""

    def __init__(
        self,
        initial: str,
        targets: Mapping[tuple[str, str], str],
        places: Mapping[str, MachineState],
        steps: tuple[str, ...],
    ) -> None:
        self.initial = initial
        self.steps = steps
        self._targets = targets
        self._places = places

    @property
    def states(self) -> tuple[str, ...]:
        """Every state that a run can be in."""
        return (*self._places, COMPLETED, ABORTED)

    @property
    def table(self) -> Mapping[tuple[str, str], str]:
        """The whole table, (state, trigger) → state."""
        return self._targets

    def may(self, state: str, trigger: str) -> bool:
        """Return whether the table has this transition."""
        return (state, trigger) in self._targets

    def next(self, state: str, trigger: str) -> str:
        """Return the state after `trigger`. Raises IllegalTransitionError if the table has no such transition."""
        try:
            return self._targets[state, trigger]
        except KeyError:
            raise IllegalTransitionError(
                f"{trigger!r} is not possible in this state",
                where=state,
                remedy=f"Possible here: {', '.join(self.triggers(state)) or 'nothing, the run has ended'}",
            ) from None

    def triggers(self, state: str) -> tuple[str, ...]:
        """Return the triggers that the table has for a state."""
        return tuple(trigger for source, trigger in self._targets if source == state)

    def place(self, state: str) -> MachineState | None:
        """Return step, phase and whether paused; None once the run has ended."""
        return self._places.get(state)


class _State(NestedState):
    """A state whose full name is joined with a character that identifiers cannot contain."""

    separator = SEPARATOR


class _Machine(HierarchicalMachine):
    """The library's machine with our separator."""

    state_cls = _State


def lifecycle(steps: Iterable[str]) -> Lifecycle:
    """Return the machine for these step identifiers, in the protocol's order (cached)."""
    return _compile(tuple(steps))


def transition_table(steps: tuple[str, ...]) -> list[tuple[str, str, str]]:
    """Return the machine's rows (trigger, source, target); a source may also be a whole step, or all of `paused`."""
    rows: list[tuple[str, str, str]] = []
    for index, step in enumerate(steps):
        # Work in progress still reports while paused, and operators may still redo: the same rules hold there.
        for paused in (False, True):
            rows += [
                (
                    rule.trigger,
                    state_name(step, rule.source, paused=paused),
                    state_name(step, rule.target, paused=paused),
                )
                for rule in STEP_RULES
            ]
            passed = state_name(step, "passed", paused=paused)
            last = index == len(steps) - 1
            rows.append(
                ("advance", passed, COMPLETED if last else state_name(steps[index + 1], "ready", paused=paused))
            )
            prefix = f"{PAUSED}{SEPARATOR}" if paused else ""
            rows += [
                (redo(step), f"{prefix}{later}", state_name(step, "ready", paused=paused)) for later in steps[index:]
            ]
        for phase in PHASES:
            rows.append(("pause", state_name(step, phase), state_name(step, phase, paused=True)))
            rows.append(("resume", state_name(step, phase, paused=True), state_name(step, phase)))
        rows.append(("abort", step, ABORTED))
    rows.append(("abort", PAUSED, ABORTED))
    return rows


def state_machine(steps: tuple[str, ...]) -> HierarchicalMachine:
    """Return the library's machine with all rows, which it checks; without a model, because nothing runs on it."""
    nested: list[dict[str, Any]] = [{"name": step, "initial": "ready", "children": list(PHASES)} for step in steps]
    return _Machine(
        model=None,
        states=[*nested, {"name": PAUSED, "children": nested}, COMPLETED, ABORTED],
        transitions=[
            {"trigger": trigger, "source": source, "dest": target}
            for trigger, source, target in transition_table(steps)
        ],
        initial=state_name(steps[0], "ready"),
        auto_transitions=False,
        ignore_invalid_triggers=True,
    )


@lru_cache(maxsize=32)
def _compile(steps: tuple[str, ...]) -> Lifecycle:
    places = {
        state_name(step, phase, paused=paused): MachineState(step, phase, paused)
        for paused in (False, True)
        for step in steps
        for phase in PHASES
    }
    outgoing: dict[str, list[tuple[str, str]]] = {}  # by a state or an enclosing state: (trigger, target)
    for trigger, event in state_machine(steps).events.items():
        for source, transitions in event.transitions.items():
            outgoing.setdefault(source, []).append((trigger, str(transitions[0].dest)))
    targets: dict[tuple[str, str], str] = {}
    for state in places:
        parts = state.split(SEPARATOR)
        for depth in range(len(parts), 0, -1):  # the innermost state that knows a trigger decides
            for trigger, target in outgoing.get(SEPARATOR.join(parts[:depth]), ()):
                targets.setdefault((state, trigger), target)
    return Lifecycle(state_name(steps[0], "ready"), targets, places, steps)
