"""The Real-Time Data Exchange protocol of a controller, version 2: packets, recipes and their types.

Big-endian. A packet is a 16-bit size (with the header), an 8-bit type, and the payload. A recipe is a list of
variables agreed upon at the start, so that later packets need no names. (Universal Robots, "Real-Time Data
Exchange (RTDE) Guide".)
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

REQUEST_VERSION = 86
CONTROLLER_VERSION = 118
DATA = 85
SETUP_OUTPUTS = 79
SETUP_INPUTS = 73
START = 83
PAUSE = 80

HEADER = struct.Struct(">HB")
MAX_PACKET = 4096
NOT_FOUND = "NOT_FOUND"

_FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}
_TYPES = {
    "DOUBLE": "timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum "
    "actual_main_voltage actual_robot_voltage actual_robot_current standard_analog_input0 "
    "standard_analog_input1 standard_analog_output0 standard_analog_output1 tool_analog_input0 "
    "tool_analog_input1 payload speed_slider_fraction standard_analog_output_0 standard_analog_output_1 "
    "tcp_force_scalar",
    "VECTOR6D": "target_q target_qd target_qdd target_current target_moment actual_q actual_qd "
    "actual_current actual_current_window joint_control_output actual_TCP_pose actual_TCP_speed "
    "actual_TCP_force target_TCP_pose target_TCP_speed joint_temperatures actual_joint_voltage ft_raw_wrench "
    "payload_inertia external_force_torque tcp_offset",
    "VECTOR3D": "actual_tool_accelerometer payload_cog elbow_position elbow_velocity",
    "VECTOR6INT32": "joint_mode",
    "INT32": "robot_mode safety_mode safety_status",
    "UINT32": "runtime_state robot_status_bits safety_status_bits speed_slider_mask "
    "output_bit_registers0_to_31 output_bit_registers32_to_63 input_bit_registers0_to_31 "
    "input_bit_registers32_to_63 io_current_types",
    "UINT64": "actual_digital_input_bits actual_digital_output_bits",
    "UINT8": "standard_digital_output_mask standard_digital_output configurable_digital_output_mask "
    "configurable_digital_output tool_digital_output_mask tool_digital_output standard_analog_output_mask "
    "standard_analog_output_type",
}
_TYPE_OF = {name: kind for kind, names in _TYPES.items() for name in names.split()}
_REGISTERS = (
    (re.compile(r"(?:in|out)put_int_register_(\d+)"), 48, "INT32"),
    (re.compile(r"(?:in|out)put_double_register_(\d+)"), 48, "DOUBLE"),
    (re.compile(r"(?:in|out)put_bit_register_(\d+)"), 128, "BOOL"),
)


def type_of(name: str) -> str:
    """The type of a variable; NOT_FOUND for an unknown one."""
    if name in _TYPE_OF:
        return _TYPE_OF[name]
    for pattern, count, kind in _REGISTERS:
        found = pattern.fullmatch(name)
        if found and int(found[1]) < count:
            return kind
    return NOT_FOUND


@dataclass(frozen=True)
class Recipe:
    """An agreed list of variables."""

    number: int
    names: tuple[str, ...]
    types: tuple[str, ...]

    @staticmethod
    def of(number: int, names: Sequence[str]) -> Recipe:
        return Recipe(number, tuple(names), tuple(type_of(n) for n in names))

    @property
    def valid(self) -> bool:
        return bool(self.names) and NOT_FOUND not in self.types

    def pack(self, values: Mapping[str, Any]) -> bytes:
        """The recipe's number and its variables. Those that ``values`` lacks are zero."""
        parts = [bytes([self.number])]
        for name, kind in zip(self.names, self.types):
            layout, value = ">" + _FORMATS[kind], values.get(name)
            if value is None:
                parts.append(bytes(struct.calcsize(layout)))
            else:
                parts.append(struct.pack(layout, *(value if kind.startswith("VECTOR") else (value,))))
        return b"".join(parts)

    def unpack(self, payload: bytes) -> dict[str, Any]:
        """Variables by name, from a payload without the recipe's number. Raises struct.error for a wrong
        size."""
        layout = ">" + "".join(_FORMATS[kind] for kind in self.types)
        flat = list(struct.unpack(layout, payload))
        values: dict[str, Any] = {}
        for name, kind in zip(self.names, self.types):
            count = int(_FORMATS[kind][0]) if kind.startswith("VECTOR") else 1
            taken, flat = flat[:count], flat[count:]
            values[name] = tuple(taken) if kind.startswith("VECTOR") else taken[0]
        return values


def packet(kind: int, payload: bytes) -> bytes:
    return HEADER.pack(HEADER.size + len(payload), kind) + payload
