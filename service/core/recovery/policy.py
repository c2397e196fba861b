"""What to do about a failed step: a pure policy from (step's recovery, error class, failures so far)."""

from __future__ import annotations

from typing import Literal

from service.core.protocol.models import Recovery

# `abort`: a person is asked, and to end the run is what is recommended. Only a person ends a run.
Policy = Literal["retry", "ask", "abort"]
MOST_WAITED_OUT = 5  # further tries of a step whose failures the computer's own want of processor time explains

# Names instead of classes, because core does not know the drivers and the events hold names.
# Transient errors: the same call may succeed in a moment. (The driver has already waited for a busy camera.)
TRIED_AGAIN = frozenset({"DeviceUnavailableError", "DeviceTimeoutError", "MachineBusyError", "StaleImageError"})
# Only a person can put these right, whatever the protocol says. (A damaged file of the evidence is restored from a
# copy; it is checked against its hash when it is read again.)
NEEDS_A_PERSON = frozenset(
    {
        "SafetyStopError",
        "LeaveNeededError",
        "ArmDepartedError",
        "ToolChangedError",
        "DriverKilledError",
        "DeviceChangedError",
        "DeviceStorageFullError",
        "IntegrityError",
        "ImagesSpoiltError",
        "SpaceShortError",
        "UnforeseenError",
    }
)


def recovery_policy(recovery: Recovery, error: str, failures: int, *, starved: bool = False) -> Policy:
    """Retry, or ask the operator.

    Args:
        recovery: the step's policy from the protocol.
        error: class name of the error that ended the work.
        failures: consecutive failures of the step, including this one (StepState.failures + 1).
        starved: the computer had no processor time for the work, which explains a device that was late.
    """
    if error in NEEDS_A_PERSON:
        return "ask"
    if error in TRIED_AGAIN and failures <= recovery.retries + (MOST_WAITED_OUT if starved else 0):
        return "retry"
    return recovery.on_failure
