"""Decodes the safety status of a Universal Robots controller."""

from __future__ import annotations

from functools import lru_cache

from drivers.errors import SafetyStopError
from drivers.interfaces import SafetyState

_STOPPED, _THREE_POSITION = 1 << 10, 1 << 11  # the switch may be in use without a stop


@lru_cache(maxsize=256)  # a controller sends few of them, another sender any
def safety_state(bits: int) -> SafetyState:
    """Decode the controller's safety_status_bits (RTDE guide); the gravest state wins."""
    for mask, state in (
        (1 << 9 | 1 << 8, SafetyState.FAULT),  # fault, violation
        (1 << 7 | 1 << 6 | 1 << 5, SafetyState.EMERGENCY_STOP),
        (1 << 4, SafetyState.SAFEGUARD_STOP),
        (1 << 2, SafetyState.PROTECTIVE_STOP),
        (1 << 3, SafetyState.FAULT),  # recovery mode
        (_THREE_POSITION, SafetyState.SAFEGUARD_STOP),
        (1 << 1, SafetyState.REDUCED),
        (1 << 0, SafetyState.NORMAL),
    ):
        if bits & mask and (mask != _THREE_POSITION or bits & _STOPPED):
            return state
    return SafetyState.UNKNOWN


def safety_error(state: SafetyState, where: str) -> SafetyStopError:
    """The error for an arm that is stopped."""
    remedy = "A person must find and clear the cause and release the stop on the pendant; then try again"
    return SafetyStopError(f"the arm is in {state.value.replace('_', ' ')}", where=where, remedy=remedy)
