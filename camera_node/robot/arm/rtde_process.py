"""The process that is connected to an arm's controller: it reads joint states and writes them to a pipe.

    python -m camera_node.robot.arm.rtde_process HOST FREQUENCY_HZ

The client library (ur_rtde) holds Python's lock while it connects, and waits forever for a controller that
accepts the connection and then does not answer. It therefore runs in its own process, which the node can end.
This process writes one ``SAMPLE`` for each new stamp, and at most one line of its own to standard error. What the
library prints is dropped, since a full pipe would stop it.
"""

from __future__ import annotations

import os
import signal
import struct
import sys
import time

from camera_node.robot.arm.arm_constants import CONNECT_S, POLL_SHARE

SAMPLE = struct.Struct("<d6d2i")
"""Controller's time in seconds, six joint angles in radians, robot mode, safety mode."""
VARIABLES = ["timestamp", "actual_q", "robot_mode", "safety_mode"]
_LONGEST_MESSAGE = 1000  # characters: a pipe holds more


def main(host: str, frequency_hz: float) -> int:
    """Write samples until the controller is gone (exit 1) or the reader is (exit 0)."""
    # The default action needs no Python: it ends a process that is stuck inside the library.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.setitimer(signal.ITIMER_REAL, CONNECT_S)
    from rtde_receive import RTDEReceiveInterface

    # The library prints to both of its outputs, which must carry samples and one message only.
    pipe, messages = os.dup(1), os.dup(2)
    for output in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), output)
    try:
        arm = RTDEReceiveInterface(host, frequency_hz, VARIABLES)
    except RuntimeError as error:
        os.write(messages, f"{host}: {error}"[:_LONGEST_MESSAGE].encode())
        return 1
    signal.setitimer(signal.ITIMER_REAL, 0)
    parent, last = os.getppid(), -1.0
    pause_s = POLL_SHARE / frequency_hz
    while os.getppid() == parent:
        time.sleep(pause_s)
        if not arm.isConnected():
            return 1
        stamp, joints = arm.getTimestamp(), arm.getActualQ()
        # Another thread writes these values: skip a pair that a new sample came between.
        if stamp == last or stamp != arm.getTimestamp() or len(joints) != 6:
            continue
        last = stamp
        try:
            os.write(pipe, SAMPLE.pack(stamp, *joints, arm.getRobotMode(), arm.getSafetyMode()))
        except BrokenPipeError:
            return 0
    return 0


if __name__ == "__main__":
    # Do not wait for the library's threads.
    os._exit(main(sys.argv[1], float(sys.argv[2])))
