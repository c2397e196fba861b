"""Turntables and linear axes under GRBL 1.1: configuration and entry point."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from drivers.plugin import DriverConfig, DriverSpec

if TYPE_CHECKING:
    from drivers.interfaces import Device

Vector3 = tuple[float, float, float]
Row = tuple[float, float, float, float]
LETTERS = "XYZABC"  # in the order of GRBL's status reports
POLL_S = 0.05  # between requests for a status report
AHEAD_S = 0.15  # of motion in the controller's buffer beyond its braking distance; it moves as long without its host
PIECE_S = 0.05  # of motion in a jog
SHORTEST_BRAKING_S = 0.1  # with less time to brake the axes would creep


class GrblAxis(BaseModel):
    """One axis in its machine coordinates, which are degrees for an axis that turns and millimetres for a slide."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    letter: Literal["X", "Y", "Z", "A", "B", "C"]  # on the controller
    carries: Literal["specimen", "camera"]  # what moves with it
    direction: Vector3  # of the axis in the base frame while all axes stand at 0; for a turn by the right-hand rule
    through_m: Vector3 = (0.0, 0.0, 0.0)  # a point on the axis of a turn, in the base frame
    from_deg: float | None = None  # an axis that turns: end of its range
    to_deg: float | None = None  # an axis that turns: other end of its range
    from_mm: float | None = None  # a slide: end of its range
    to_mm: float | None = None  # a slide: other end of its range

    @model_validator(mode="after")
    def _one_range(self) -> Self:
        ranges = [pair for pair in ((self.from_deg, self.to_deg), (self.from_mm, self.to_mm)) if pair != (None, None)]
        if len(ranges) != 1 or None in ranges[0]:
            raise ValueError("an axis needs either from_deg and to_deg, or from_mm and to_mm")
        if self.lowest >= self.highest:
            raise ValueError("the range of an axis begins below its end")
        if abs(sum(v * v for v in self.direction) - 1.0) > 1e-3:
            raise ValueError("the direction of an axis has length 1")
        return self

    @property
    def turns(self) -> bool:
        """Return whether the axis turns; otherwise it slides."""
        return self.from_deg is not None

    @property
    def lowest(self) -> float:
        """Lower end of the range in machine coordinates."""
        return next(v for v in (self.from_deg, self.from_mm) if v is not None)

    @property
    def highest(self) -> float:
        """Upper end of the range in machine coordinates."""
        return next(v for v in (self.to_deg, self.to_mm) if v is not None)


class GrblConfig(DriverConfig):
    """A turntable or linear axes under a GRBL controller; for protocols it is a robot."""

    port: str = Field(min_length=1, description="serial device, link to one, or socket://HOST:PORT")
    baudrate: int = Field(default=115200, gt=0, description="of the serial line")
    axes: Annotated[tuple[GrblAxis, ...], Field(min_length=1, max_length=6)] = Field(
        description="the axes, those that carry the same thing from the room outwards"
    )
    T_base_flange_zero: tuple[Row, Row, Row, Row] = Field(
        description="the camera's mount in the base frame while all axes stand at 0; the base frame moves with the "
        "specimen, from a drawing or measured with a tape"
    )
    reach_within_m: float = Field(
        default=0.05,
        gt=0,
        description="how far from a viewpoint the camera may end up, since few axes reach few poses",
    )
    reach_within_deg: float = Field(default=5.0, gt=0, description="by how much it may be turned there")
    slide_speed_m_s: float = Field(default=0.02, gt=0, description="of slides, for which protocols state no speed")
    connect_timeout_s: float = Field(default=5.0, gt=0, description="longest wait for the controller to start")
    answer_timeout_s: float = Field(default=2.0, gt=0, description="longest wait for the answer to a line")
    homing_timeout_s: float = Field(default=90.0, gt=0, description="longest time that homing takes")
    stale_after_s: float = Field(
        default=1.0, gt=0, description="age of the newest status report above which the link counts as dead"
    )
    unattended_s: float = Field(
        default=5.0, gt=0, description="time after which moving axes are stopped whose program does not query them"
    )
    watchdog_s: float = Field(
        default=0.2,
        ge=0.1,
        description="time without a heartbeat of the program that drives the axes after which they are stopped",
    )
    rest_within_s: float = Field(
        default=0.5,
        ge=0.4,
        description="longest time until the axes stand after the death of program, driver or line; it limits their "
        "speed to one from which they brake in time",
    )

    @model_validator(mode="after")
    def _each_axis_once(self) -> Self:
        if len({axis.letter for axis in self.axes}) != len(self.axes):
            raise ValueError("each letter names one axis")
        return self

    @model_validator(mode="after")
    def _time_to_brake(self) -> Self:
        if self.rest_within_s < self.reaction_s + SHORTEST_BRAKING_S - 1e-9:
            least_s = self.reaction_s + SHORTEST_BRAKING_S
            raise ValueError(f"with this watchdog_s the axes rest after {least_s:g} s at the earliest: rest_within_s")
        return self

    @property
    def reaction_s(self) -> float:
        """Time until the axes brake after the death of program, driver or line.

        Until then what was handed over is moved, or a heartbeat is missed and a report comes.
        """
        return max(AHEAD_S + 1.5 * PIECE_S, self.watchdog_s + POLL_S) + 0.05

    @property
    def stood_still_s(self) -> float:
        """A longer gap between two looks at the line means that this process was suspended."""
        return self.watchdog_s + 0.1

    @property
    def longest_call_s(self) -> float:
        """Homing is part of giving leave to move."""
        return self.homing_timeout_s + self.connect_timeout_s + 10.0


def _build(config: GrblConfig) -> Device:
    from drivers.grbl.table import GrblTable  # noqa: PLC0415 - only the child process needs it

    return GrblTable(config)


# Hosted although there is no native library: the heartbeat of the program reaches only a driver's own process.
DRIVER = DriverSpec(kind="robot", config=GrblConfig, build=_build, hosted=True, call_timeout_s=30.0, is_arm=False)
