"""The Real-Time Data Exchange protocol of a controller, version 2: packets, recipes and their types.

Big-endian. A packet is a 16-bit size (with the header), an 8-bit type, and the payload. A recipe is a list of
variables agreed upon at the start, so that later packets need no names. (Universal Robots, "Real-Time Data
Exchange (RTDE) Guide".) Only the variables that the client library and ``rtde_process`` ask for are known.
"""

from __future__ import annotations

import itertools
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

_FORMATS = {"UINT32": "I", "INT32": "i", "DOUBLE": "d", "VECTOR6D": "6d"}
_TYPES = {
    "timestamp": "DOUBLE",
    "actual_q": "VECTOR6D",
    "external_force_torque": "VECTOR6D",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "runtime_state": "UINT32",
    "robot_status_bits": "UINT32",
    "safety_status_bits": "UINT32",
}
_REGISTER = re.compile(r"(?:in|out)put_(int|double)_register_(\d+)")
_REGISTERS = 48


def type_of(name: str) -> str:
    """The type of a variable; NOT_FOUND for an unknown one."""
    register = _REGISTER.fullmatch(name)
    if register and int(register[2]) < _REGISTERS:
        return "INT32" if register[1] == "int" else "DOUBLE"
    return _TYPES.get(name, NOT_FOUND)


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
                parts.append(struct.pack(layout, *(value if kind == "VECTOR6D" else (value,))))
        return b"".join(parts)

    def unpack(self, payload: bytes) -> dict[str, Any]:
        """Variables by name, from a payload without the recipe's number. Raises struct.error for a wrong
        size."""
        flat = iter(struct.unpack(">" + "".join(_FORMATS[kind] for kind in self.types), payload))
        return {
            name: tuple(itertools.islice(flat, 6)) if kind == "VECTOR6D" else next(flat)
            for name, kind in zip(self.names, self.types)
        }


def packet(kind: int, payload: bytes) -> bytes:
    return HEADER.pack(HEADER.size + len(payload), kind) + payload
