"""The message of the primary interface that states with which kinematics the controller computes."""

from __future__ import annotations

import struct

from simulators.ur_controller.kinematics import Model

_VERSION, _STATE, _KINEMATICS = 20, 16, 5
_CHECKSUM, _LINEARISED = 0xFFFFFFFF, 2


def kinematics_message(model: Model) -> bytes:
    """A robot message with the version, which comes first, and a robot state whose only part is the kinematics."""
    numbers = (*model.theta_rad, *model.a_m, *model.d_m, *model.alpha_rad)
    part = struct.pack(">6I24dI", *(_CHECKSUM,) * 6, *numbers, _LINEARISED)
    part = struct.pack(">IB", 5 + len(part), _KINEMATICS) + part
    greeting = struct.pack(">QbbB", 0, -2, 3, len(model.name)) + model.name.encode()
    return b"".join(
        struct.pack(">IB", 5 + len(body), kind) + body for kind, body in ((_VERSION, greeting), (_STATE, part))
    )
