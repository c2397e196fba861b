"""FaultPlan: which message of which simulated device fails, and how."""

from __future__ import annotations

import threading
from collections import Counter
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from simulators.serve import SimulatorError

ANY = "*"


class Fault(BaseModel):
    """One planned fault of the `nth` (from 1) message `on` of `device`, and of the `times` - 1 messages after it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    device: str
    on: str = Field(description="name of the message or operation; * matches every message of the device")
    kind: str = Field(
        description="drop, stall, truncate, corrupt, reject, protective_stop, disk_full, smear, black, …"
    )
    nth: int = Field(default=1, ge=1)
    times: int = Field(default=1, ge=1)
    value: float | int | str | bool | None = Field(
        default=None, description="what the kind needs: seconds, bytes, links"
    )

    def due(self, count: int) -> bool:
        """Return whether the count-th (from 1) matching message is to fail."""
        return self.nth <= count < self.nth + self.times


_FAULTS = TypeAdapter(tuple[Fault, ...])


class FaultPlan:
    """The faults of a simulator, with their message counters; thread-safe."""

    def __init__(self, faults: tuple[Fault, ...] = ()) -> None:
        self.faults = faults
        self._counts: Counter[tuple[str, str]] = Counter()
        self._lock = threading.Lock()

    @classmethod
    def parse(cls, text: str) -> FaultPlan:
        """Parse a JSON list of faults, or read the file of that name. Raises SimulatorError naming the mistake."""
        source = text.strip()
        if not source:
            return cls()
        if not source.startswith(("[", "{")):
            try:
                source = Path(source).read_text(encoding="utf-8").strip()
            except (OSError, ValueError) as error:  # ValueError: an impossible path, or a file that is not text
                why = getattr(error, "strerror", None) or error
                raise SimulatorError(f"the fault plan {text[:80]!a} cannot be read: {why}") from error
        if source.startswith("{"):
            source = f"[{source}]"
        try:
            return cls(_FAULTS.validate_json(source))
        except ValidationError as error:
            first = error.errors()[0]
            field = ".".join(str(part) for part in first["loc"])[:80]
            raise SimulatorError(f"the fault plan is wrong at {field or 'its start'!a}: {first['msg']}") from error

    def to_json(self) -> str:
        """Return the plan as JSON that parse() reads; counters are not included."""
        return _FAULTS.dump_json(self.faults).decode()

    def of(self, device: str, called: str) -> FaultPlan:
        """The faults of a device, for its simulator, which calls itself by another name."""
        mine = (fault for fault in self.faults if fault.device == device)
        return FaultPlan(tuple(fault.model_copy(update={"device": called}) for fault in mine))

    def check(self, device: str, message: str) -> Fault | None:
        """Count this message and return the fault that is due for it, or None."""
        with self._lock:
            self._counts[device, message] += 1
            self._counts[device, ANY] += 1
            for fault in self.faults:
                if (
                    fault.device == device
                    and fault.on in (message, ANY)
                    and fault.due(self._counts[device, fault.on])
                ):
                    return fault
        return None
