"""Wakes the event loop at an exact instant.

asyncio rounds its own timers up to the selector's millisecond (p99 2 ms late on an idle machine). A Linux
timerfd is a file that becomes readable when the kernel's high-resolution timer fires: the loop wakes on it as
on a socket, without a second thread. On other systems asyncio's timers are used.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import sys
from collections.abc import Callable

_CLOCK_MONOTONIC = 1
_NONBLOCK_CLOEXEC = os.O_NONBLOCK | getattr(os, "O_CLOEXEC", 0)


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


class _Itimerspec(ctypes.Structure):
    _fields_ = (("it_interval", _Timespec), ("it_value", _Timespec))


class LoopTimer:
    """Calls ``fire()`` on the running event loop once the armed time has passed. Holds one instant only."""

    def __init__(self, fire: Callable[[], None]) -> None:
        self._fire = fire
        self._loop = asyncio.get_running_loop()
        self._handle: asyncio.TimerHandle | None = None
        self._fd = -1
        if sys.platform == "linux":
            # PyDLL keeps the interpreter lock: these calls take a microsecond, releasing it takes longer.
            self._libc = ctypes.PyDLL(None, use_errno=True)
            self._fd = self._libc.timerfd_create(_CLOCK_MONOTONIC, _NONBLOCK_CLOEXEC)
        if self._fd >= 0:
            self._spec = _Itimerspec()
            self._loop.add_reader(self._fd, self._readable)

    def arm(self, in_ns: int) -> None:
        """Fire ``in_ns`` from now (at once if not positive). Replaces what was armed before."""
        if self._fd < 0:
            if self._handle is not None:
                self._handle.cancel()
            self._handle = self._loop.call_later(max(in_ns, 0) / 1e9, self._fire)
            return
        value = self._spec.it_value
        # Zero would disarm it.
        value.tv_sec, value.tv_nsec = divmod(max(in_ns, 1), 10**9)
        self._libc.timerfd_settime(self._fd, 0, ctypes.byref(self._spec), None)

    def close(self) -> None:
        if self._handle is not None:
            self._handle.cancel()
        if self._fd >= 0:
            self._loop.remove_reader(self._fd)
            os.close(self._fd)
            self._fd = -1

    def _readable(self) -> None:
        with contextlib.suppress(BlockingIOError):  # re-armed between becoming readable and now
            os.read(self._fd, 8)
        self._fire()
