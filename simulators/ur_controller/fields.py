"""The RTDE fields of a controller: names, types and the software version that introduced each."""

from __future__ import annotations

Version = tuple[int, int]
NEVER: Version = (99, 0)

VECTORS_6: tuple[str, ...] = (
    "target_q",
    "target_qd",
    "target_qdd",
    "target_current",
    "target_moment",
    "actual_q",
    "actual_qd",
    "actual_current",
    "joint_control_output",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "target_TCP_pose",
    "target_TCP_speed",
    "joint_temperatures",
    "actual_joint_voltage",
)
DOUBLES: tuple[str, ...] = (
    "timestamp",
    "actual_execution_time",
    "speed_scaling",
    "target_speed_fraction",
    "actual_momentum",
    "actual_main_voltage",
    "actual_robot_voltage",
    "actual_robot_current",
    "standard_analog_input0",
    "standard_analog_input1",
    "standard_analog_output0",
    "standard_analog_output1",
    "io_current",
    "tool_analog_input0",
    "tool_analog_input1",
    "tool_output_current",
    "tool_temperature",
    "tcp_force_scalar",
)
UINT32S: tuple[str, ...] = (
    "runtime_state",
    "robot_status_bits",
    "safety_status_bits",
    "analog_io_types",
    "tool_mode",
    "tool_analog_input_types",
    "output_bit_registers0_to_31",
    "output_bit_registers32_to_63",
    "input_bit_registers0_to_31",
    "input_bit_registers32_to_63",
)

# name: (type, since on CB3, since on e-Series)
_LATER: dict[str, tuple[str, Version, Version]] = {
    "safety_status": ("INT32", (3, 10), (5, 4)),
    "elbow_position": ("VECTOR3D", (3, 5), (5, 0)),
    "elbow_velocity": ("VECTOR3D", (3, 5), (5, 0)),
    "script_control_line": ("UINT32", NEVER, (5, 0)),
    "payload": ("DOUBLE", (3, 11), (5, 5)),
    "payload_cog": ("VECTOR3D", (3, 11), (5, 5)),
    "payload_inertia": ("VECTOR6D", (3, 15), (5, 11)),
    # Not in the guide: the maker's client library has it since these versions (its pull request 110).
    "tcp_offset": ("VECTOR6D", (3, 12), (5, 5)),
    "ft_raw_wrench": ("VECTOR6D", NEVER, (5, 9)),
    "actual_current_as_torque": ("VECTOR6D", NEVER, (5, 23)),
}

INPUTS: dict[str, str] = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "input_bit_registers0_to_31": "UINT32",
    "input_bit_registers32_to_63": "UINT32",
    "external_force_torque": "VECTOR6D",
}


def register_count(version: Version) -> int:
    """Number of integer and double registers per direction: the upper 24 were added in 3.9 and 5.3."""
    return 48 if version >= ((3, 9) if version[0] < 5 else (5, 3)) else 24


def outputs(version: Version) -> dict[str, str]:
    """Name → type of all fields that this version can stream."""
    table: dict[str, str] = dict.fromkeys(VECTORS_6, "VECTOR6D")
    table |= dict.fromkeys(DOUBLES, "DOUBLE")
    table |= dict.fromkeys(UINT32S, "UINT32")
    table |= {
        "actual_digital_input_bits": "UINT64",
        "actual_digital_output_bits": "UINT64",
        "robot_mode": "INT32",
        "joint_mode": "VECTOR6INT32",
        "safety_mode": "INT32",
        "actual_tool_accelerometer": "VECTOR3D",
        "tool_output_voltage": "INT32",
    }
    for name, (kind, cb3, e_series) in _LATER.items():
        if version >= (e_series if version[0] >= 5 else cb3):
            table[name] = kind
    for direction in ("output", "input"):
        for i in range(register_count(version)):
            table[f"{direction}_int_register_{i}"] = "INT32"
            table[f"{direction}_double_register_{i}"] = "DOUBLE"
    return table


def inputs(version: Version) -> dict[str, str]:
    """Name → type of all fields that a client may write."""
    table = dict(INPUTS)
    for i in range(register_count(version)):
        table[f"input_int_register_{i}"] = "INT32"
        table[f"input_double_register_{i}"] = "DOUBLE"
    return table
