"""What ends a motion."""

from __future__ import annotations

import signal

import pytest

from camera_node.robot.arm.control import stop_event

NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.mark.parametrize("under_nohup", [False, True])
def test_signals_end_a_motion_and_a_closed_terminal_too_unless_it_is_ignored(under_nohup):
    before = {number: signal.getsignal(number) for number in NUMBERS}
    signal.signal(signal.SIGHUP, signal.SIG_IGN if under_nohup else signal.SIG_DFL)
    try:
        for number in NUMBERS:
            requested = stop_event()
            signal.raise_signal(number)
            assert requested.is_set() != (under_nohup and number == signal.SIGHUP)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
