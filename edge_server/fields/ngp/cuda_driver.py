"""Whether there may be a GPU that torch could use, found out without importing torch, which takes time."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

# What a driver leaves: NVIDIA's devices, AMD's (which torch calls cuda, too), and NVIDIA's library, which is
# all there is under Windows and its subsystem for Linux.
_DEVICES = ("nvidia*", "kfd")
_LIBRARY = "nvcuda.dll" if os.name == "nt" else "libcuda.so.1"


def driver_present(devices: Path = Path("/dev"), library: str = _LIBRARY) -> bool:
    """Whether a GPU's driver is installed: without one, no device is worth asking torch for."""
    if any(True for pattern in _DEVICES for _ in devices.glob(pattern)):
        return True
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
