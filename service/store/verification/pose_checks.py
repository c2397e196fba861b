"""Whether the pose of each recorded view fits the joints recorded with it: a tool changed unseen shows here.

Only arms whose controllers report the pose of the tool are judged. Others report the flange, whatever the tool.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from service.core.recorded_devices import recorded_report
from service.core.units import deg, mm

if TYPE_CHECKING:
    from service.core.arms.model import ArmModel


@dataclass(frozen=True, slots=True)
class ReportedPose:
    """A view's place as a viewpoint_captured event holds it: its name, and where the controller had the arm."""

    step: str
    viewpoint: str
    station: str
    joints_rad: Sequence[float]  # (N,)
    T_base_flange: Sequence[Sequence[float]]  # (4, 4)


@dataclass(frozen=True, slots=True)
class AwayView:
    """A view whose pose does not fit its joints, by so much."""

    seq: int
    viewpoint: str
    distance_m: float
    angle_rad: float

    def __str__(self) -> str:
        return (
            f"the pose of {self.viewpoint} is {mm(self.distance_m):.0f} mm and {deg(self.angle_rad):.1f}° from where "
            "its recorded joints put the flange: the tool at the controller was not the one reckoned with"
        )


@dataclass
class PoseFacts:
    """The arms of a run, and those of its views whose pose does not fit their joints."""

    _arms: dict[str, ArmModel | None] = field(default_factory=dict[str, "ArmModel | None"])  # None: cannot be judged
    _away: dict[int, AwayView] = field(default_factory=dict[int, AwayView])
    _last: dict[tuple[str, ...], int] = field(default_factory=dict[tuple[str, ...], int])  # view → its newest event

    def open(self, device: str, report: object) -> None:
        """Add a device_opened event: the device's name in rig.yaml, and its DeviceReport as plain data."""
        from service.core.arms.model import known_arm  # noqa: PLC0415 - searches for plug-ins

        identity = recorded_report(report).identity
        if identity.kind == "robot":
            arm = known_arm(identity.model)
            self._arms[device] = arm if arm is not None and arm.family == "universal_robot" else None

    def look(self, seq: int, view: ReportedPose) -> None:
        """Add a viewpoint_captured event."""
        self._last[view.step, view.viewpoint, view.station] = seq
        if not self._arms or None in self._arms.values():
            return
        import numpy as np  # noqa: PLC0415 - which few verifications need

        from service.core.arms.model import fits, flange_pose, pose_gap  # noqa: PLC0415

        joints, pose = np.array(view.joints_rad, dtype=float), np.array(view.T_base_flange, dtype=float)
        gaps = [pose_gap(flange_pose(a, joints), pose) for a in self._arms.values() if a and a.axes == len(joints)]
        if gaps and not any(map(fits, gaps)):
            self._away[seq] = AwayView(seq, view.viewpoint, *min(gaps))

    def findings(self, run_id: str) -> tuple[list[AwayView], list[str]]:
        """Return views whose newest image has a wrong pose, and notes on those that were taken again since."""
        newest = set(self._last.values())
        faults = [away for seq, away in self._away.items() if seq in newest]
        return faults, list(self._notes(run_id, newest))

    def _notes(self, run_id: str, newest: set[int]) -> Iterator[str]:
        for seq, away in self._away.items():
            if seq not in newest:
                yield f"{run_id}, event {seq}: {away}. It was taken again since"
