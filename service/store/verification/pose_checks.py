"""Whether the pose of each recorded view fits the joints recorded with it: a tool changed unseen shows here.

Only arms whose controllers report the pose of the tool are judged. Others report the flange, whatever the tool.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from service.core.recorded_devices import recorded_report
from service.core.units import deg, mm
from service.core.words import counted

if TYPE_CHECKING:
    from service.core.arms import ArmModel

NOT_COMPARED = " are not compared, because "  # in every sentence on views that are not judged


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


@dataclass(frozen=True, slots=True)
class _OpenedArm:
    """An arm as it was opened: its model's name, and its kinematics or why its views cannot be judged."""

    model: str
    kinematics: ArmModel | None
    why_not: str = ""

    @classmethod
    def of(cls, model: str) -> _OpenedArm:
        from service.core.arms import known_arm  # noqa: PLC0415 - searches for plug-ins

        arm = known_arm(model)
        if arm is None:
            return cls(model, None, f"no kinematics are known for an arm {model!r}")
        if arm.family != "universal_robot":
            return cls(model, None, f"the controller of an arm {model} reports the flange, whatever its tool")
        return cls(model, arm)


@dataclass
class PoseFacts:
    """The arms of a run, those of its views whose pose does not fit their joints, and those that cannot be judged."""

    _arms: dict[str, _OpenedArm] = field(default_factory=dict[str, _OpenedArm])
    _unjudged: Counter[str] = field(default_factory=Counter[str])  # reason → number of views
    _away: dict[int, AwayView] = field(default_factory=dict[int, AwayView])
    _last: dict[tuple[str, ...], int] = field(default_factory=dict[tuple[str, ...], int])  # view → its newest event

    def open(self, device: str, report: object) -> None:
        """Add a device_opened event: the device's name in rig.yaml, and its DeviceReport as plain data."""
        identity = recorded_report(report).identity
        if identity.kind == "robot":
            self._arms[device] = _OpenedArm.of(identity.model)

    def look(self, seq: int, view: ReportedPose) -> None:
        """Add a viewpoint_captured event."""
        self._last[view.step, view.viewpoint, view.station] = seq
        why_not = next((arm.why_not for arm in self._arms.values() if arm.why_not), "")
        if why_not or not self._arms:
            self._unjudged[why_not or "the record names no arm that was connected before"] += 1
            return
        import numpy as np  # noqa: PLC0415 - which few verifications need

        from service.core.arms import fits, flange_pose, pose_gap  # noqa: PLC0415

        joints, pose = np.array(view.joints_rad, dtype=float), np.array(view.T_base_flange, dtype=float)
        arms = [arm.kinematics for arm in self._arms.values()]
        gaps = [pose_gap(flange_pose(a, joints), pose) for a in arms if a and a.axes == len(joints)]
        if not gaps:
            models = " and ".join(dict.fromkeys(arm.model for arm in self._arms.values()))
            self._unjudged[f"an arm {models} has not the {len(joints)} joints that were recorded"] += 1
        elif not any(map(fits, gaps)):
            self._away[seq] = AwayView(seq, view.viewpoint, *min(gaps))

    def not_judged(self) -> list[str]:
        """Return a sentence for each reason for which views are not judged, with their number."""
        return [
            f"pose and joints of {counted(number, 'view')}{NOT_COMPARED}{reason}"
            for reason, number in self._unjudged.items()
        ]

    def findings(self, run_id: str) -> tuple[list[AwayView], list[str]]:
        """Return views whose newest image has a wrong pose, and notes on those that were taken again since."""
        newest = set(self._last.values())
        faults = [away for seq, away in self._away.items() if seq in newest]
        return faults, list(self._notes(run_id, newest))

    def _notes(self, run_id: str, newest: set[int]) -> Iterator[str]:
        for seq, away in self._away.items():
            if seq not in newest:
                yield f"{run_id}, event {seq}: {away}. It was taken again since"
