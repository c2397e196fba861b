"""Limits of a simulated rig on a machine that other programs use too: a busy machine is no dead link."""

from __future__ import annotations

from typing import Any

# The limits that guard against a dead program, device or line, with their defaults in seconds.
_UR = {"connect_timeout_s": 5.0, "stale_after_s": 1.0, "unattended_s": 5.0}
_GUARDS: dict[str, dict[str, float]] = {
    "ur": _UR,
    "kuka_sunrise": {**_UR, "answer_timeout_s": 3.0},
    "lightbox": {"timeout_s": 1.0},
}
_LONGEST_WATCHDOG_S = 1.0  # that the driver sets; this controller waits longer (--patience)


def patient(section: dict[str, Any], patience_s: float) -> dict[str, Any]:
    """A device's section of rig.yaml in which no guard waits less than `patience_s`; as it was for 0."""
    if patience_s <= 0.0:
        return section
    guards = {name: max(usual_s, patience_s) for name, usual_s in _GUARDS.get(section["driver"], {}).items()}
    if section["driver"] == "ur":
        guards["watchdog_s"] = _LONGEST_WATCHDOG_S
        guards["rest_within_s"] = patience_s  # nobody stands beside it
    return {**section, **guards}
