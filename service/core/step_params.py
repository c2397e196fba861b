"""Params of steps: the bases from which the core learns what it must know of a step kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

from pydantic import BaseModel

from service.core.records.base import Record


@dataclass(frozen=True, slots=True)
class RepeatedStep:
    """The meaning of trying a kind of step again after its figures were outside their limits.

    Attributes:
        words: the advice: what to do, and what happens then.
        same: true if it gives the same figures unless a step it depends on is done again.
        device: true if a device can fail during the step.
        computes: true if a computation can fail during the step.
    """

    words: str
    same: bool = False
    device: bool = True
    computes: bool = True


# What other steps, pages, the audit and exports look for in the results of a run.
Gives = Literal[
    "calibration", "ct_surface", "scan_surface", "rough_spheres", "registrations", "accuracy", "ground_truth"
]


@dataclass(frozen=True, slots=True)
class NeededDevice:
    """A device that a step cannot do without: the rig's only one of its kind, or the one of this name."""

    kind: Literal["camera", "scanner", "ct"]
    name: str | None = None


class StepParams(Record):
    """Base of the params of every step kind.

    Attributes:
        gives: the kind of result that other steps look for in such a step; None: they look for nothing in it.
        by_hand: true if a person takes its images with the camera in the hand, as many as are needed.
        only_ticks: true if it is nothing but what people tick.
        repeated: the meaning of trying such a step again.
        needs_disk: true if such a step stores files; the others also run when the disk is full.
    """

    gives: ClassVar[Gives | None] = None
    by_hand: ClassVar[bool] = False
    only_ticks: ClassVar[bool] = False
    repeated: ClassVar[RepeatedStep] = RepeatedStep("Put right what the figures show, then try this step again")
    needs_disk: ClassVar[bool] = True

    @property
    def moves_robot(self) -> bool:
        """True if the robot moves during this step with these params."""
        return False

    @property
    def photographs_specimen(self) -> bool:
        """True if this step takes images of the specimen, which nobody can take again once it was changed."""
        return False

    @property
    def needed_devices(self) -> tuple[NeededDevice, ...]:
        """The devices that this step cannot do without, besides the robots of its stations."""
        return ()


class MovingParams(StepParams):
    """Base of the params of a step kind that moves the robot; such a step never begins without a person."""

    @property
    def moves_robot(self) -> bool:
        """True, unless a step kind's own params say otherwise."""
        return True


@dataclass(frozen=True, slots=True)
class NamesStep:
    """Marks a field of params whose value names an earlier step, or several.

    Attributes:
        does: the thing such a step must do, as a phrase: `imports a scan`.
        fits: says if a step with these params does it.
    """

    does: str
    fits: Callable[[StepParams], bool]


def names_step(does: str, *gives: Gives) -> NamesStep:
    """Return the mark of a field that names a step whose result is one of these."""
    return NamesStep(does, lambda params: params.gives in gives)


NAMES_CALIBRATION = names_step("calibrates", "calibration")
NAMES_CT = names_step("imports a CT", "ct_surface")
NAMES_SCAN = names_step("imports a scan", "scan_surface")
NAMES_SPHERES = names_step("locates spheres", "ct_surface", "scan_surface", "rough_spheres")
NAMES_REGISTRATION = names_step("registers", "registrations")
NAMES_CAPTURE = NamesStep(
    "takes photographs", lambda params: params.gives in (None, "calibration") and params.needs_disk
)


def named_steps(params: BaseModel) -> Iterator[tuple[tuple[str | int, ...], str, NamesStep]]:
    """Yield every step that params name: the place of the name in them, the name, and the mark of its field."""
    for field, info in type(params).model_fields.items():
        value: object = getattr(params, field)
        mark = next((one for one in info.metadata if isinstance(one, NamesStep)), None)
        if isinstance(value, BaseModel):
            yield from (((field, *at), name, inner) for at, name, inner in named_steps(value))
        elif mark is not None and isinstance(value, str):
            yield (field,), value, mark
        elif mark is not None and isinstance(value, tuple):
            yield from (((field, number), str(name), mark) for number, name in enumerate(value))
