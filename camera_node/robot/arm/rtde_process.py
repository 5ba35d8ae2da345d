"""The process that holds the connection to an arm's controller: reads joint states, writes them to a pipe.

    python -m camera_node.robot.arm.rtde_process HOST FREQUENCY_HZ

Apart from the node because the client library (ur_rtde) holds Python's lock while it connects, and waits for
ever for a controller that has accepted and then says nothing: a node must be able to end it. What goes down
the pipe is ``SAMPLE``, one for each new stamp; silence means that there is none.
"""

from __future__ import annotations

import os
import signal
import struct
import sys
import time

SAMPLE = struct.Struct("<d6d2i")
"""Controller's time in seconds, six joint angles in radians, robot mode, safety mode."""
VARIABLES = ["timestamp", "actual_q", "robot_mode", "safety_mode"]
CONNECT_S = 2.5
_LIBRARY_MISSING = 3


def main(host: str, frequency_hz: float) -> int:
    """Until the controller is gone (exit 1) or nobody reads any more (exit 0)."""
    # The default action needs no Python: it ends a process that is stuck inside the library.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.setitimer(signal.ITIMER_REAL, CONNECT_S)
    try:
        from rtde_receive import RTDEReceiveInterface
    except ImportError:
        return _LIBRARY_MISSING
    # What the library prints there must not come between the samples.
    pipe = os.dup(1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    try:
        arm = RTDEReceiveInterface(host, frequency_hz, VARIABLES)
    except RuntimeError as error:
        print(f"{host}: {error}", file=sys.stderr)
        return 1
    signal.setitimer(signal.ITIMER_REAL, 0)
    parent, last = os.getppid(), -1.0
    pause_s = 0.25 / frequency_hz
    while os.getppid() == parent:
        time.sleep(pause_s)
        if not arm.isConnected():
            return 1
        stamp, joints = arm.getTimestamp(), arm.getActualQ()
        # Another thread writes these: a pair that a new sample has come between is left for the next look.
        if stamp == last or stamp != arm.getTimestamp() or len(joints) != 6:
            continue
        last = stamp
        try:
            os.write(pipe, SAMPLE.pack(stamp, *joints, arm.getRobotMode(), arm.getSafetyMode()))
        except BrokenPipeError:
            return 0
    return 0


if __name__ == "__main__":
    # What the library's threads still hold must not delay the end.
    os._exit(main(sys.argv[1], float(sys.argv[2])))
