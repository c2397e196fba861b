"""How patient tests are with devices: a busy machine is no dead link. Tests marked `realtime` use the real limits."""

from __future__ import annotations

from drivers.grbl import GrblConfig

PATIENCE_S = 20.0  # less than the driver's calls may take (drivers.plugin)
#: What guards a device against a dead program or line, for a driver's section of a rig file.
PATIENT_UR: dict[str, float] = {
    "connect_timeout_s": PATIENCE_S, "watchdog_s": 1.0, "rest_within_s": PATIENCE_S, "stale_after_s": PATIENCE_S,
    "unattended_s": PATIENCE_S,
}  # fmt: skip
PATIENT_KUKA: dict[str, float] = {
    "connect_timeout_s": PATIENCE_S, "answer_timeout_s": PATIENCE_S, "stale_after_s": PATIENCE_S,
    "unattended_s": PATIENCE_S,
}  # fmt: skip
# As fast as with the usual limits: there the axes have 0.2 s to brake.
_BRAKING_S = GrblConfig.model_fields["rest_within_s"].default - 0.3
PATIENT_GRBL: dict[str, float] = {
    **PATIENT_KUKA, "watchdog_s": PATIENCE_S, "rest_within_s": PATIENCE_S + 0.1 + _BRAKING_S,
}  # fmt: skip
