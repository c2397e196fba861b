"""Fields of the RTDE stream that a fault plan leaves out, makes nonsense of, or freezes.

`{"device": "robot", "on": "field actual_q", "kind": "absent"}`: a client cannot have this field. `nan` and `freeze`
begin with the `nth` data package of a client; an integer has no NaN, and becomes the number with all bits set.
"""

from __future__ import annotations

import math

from simulators.faults import Fault, FaultPlan

_MOST = {"UINT8": 0xFF, "UINT32": 0xFFFFFFFF, "UINT64": (1 << 64) - 1}  # signed ones: -1


class SpoiltFields:
    """Holds what one client gets instead of the fields that it asked for."""

    def __init__(self, plan: FaultPlan, device: str) -> None:
        self._faults = {
            fault.on.removeprefix("field "): fault
            for fault in plan.faults
            if fault.device == device and fault.on.startswith("field ")
        }
        self._packages = 0
        self._frozen: dict[str, tuple[float, ...]] = {}

    def __bool__(self) -> bool:
        """Return whether the plan spoils any field."""
        return bool(self._faults)

    def absent(self, name: str) -> bool:
        """Return whether the controller does not know this field."""
        return name in self._faults and self._faults[name].kind == "absent"

    def next_package(self) -> None:
        """Begin another data package."""
        self._packages += 1

    def value(self, name: str, kind: str, value: tuple[float, ...]) -> tuple[float, ...]:
        """Return what the client gets for a field of this RTDE type."""
        fault = self._faults.get(name)
        if fault is None or not self._due(fault):
            return value
        if fault.kind == "nan":
            nothing = math.nan if kind in ("DOUBLE", "VECTOR3D", "VECTOR6D") else _MOST.get(kind, -1)
            return (nothing,) * len(value)
        return self._frozen.setdefault(name, value)

    def _due(self, fault: Fault) -> bool:
        return self._packages >= fault.nth
