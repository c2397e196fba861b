"""What to do about a failed step: a pure policy from (step's recovery, error class, failures so far)."""

from __future__ import annotations

from typing import Literal

from service.core.protocol.models import Recovery

Policy = Literal["retry", "ask", "abort"]

# Names, not classes: core does not know the drivers, and the events hold names.
# Passing troubles: the same call may succeed in a moment. (A camera that stays busy has been waited for already.)
PASSING = frozenset({"DeviceUnavailableError", "DeviceTimeoutError", "StaleImageError"})
# Only a person at the table can put these right, whatever the protocol says.
# (a damaged file of the evidence is put back from a copy; what is read again is checked against its hash again).
NEEDS_A_PERSON = frozenset(
    {
        "SafetyStopError",
        "LeaveNeededError",
        "DeviceStorageFullError",
        "IntegrityError",
        "ImagesSpoiltError",
        "SpaceShortError",
    }
)


def recovery_policy(recovery: Recovery, error: str, failures: int) -> Policy:
    """Retry, ask the operator, or abort.

    Args:
        recovery: the step's policy from the protocol.
        error: class name of the error that ended the work.
        failures: how often the step has failed in a row, this failure included (StepState.failures + 1).
    """
    if error in NEEDS_A_PERSON:
        return "ask"
    if error in PASSING and failures <= recovery.retries:
        return "retry"
    return recovery.on_failure
