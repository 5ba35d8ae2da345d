"""Renders a camera's frames ahead in a process of its own, which takes its memory with it when it ends.

Casting a large image takes hundreds of megabytes; a node that streams finished frames needs none of them.
The child writes the frames to the cache's folder, where the node then finds them.
"""

from __future__ import annotations

import logging
import pickle
import subprocess
import sys
import time
from collections.abc import Callable

from camera_node.config import WorldConfig
from freshfield.scenario import Scenario

log = logging.getLogger("camera-node")

_POLL_S = 0.1


def fill_in_child(scenario: Scenario, config: WorldConfig, camera: str, stopped: Callable[[], bool]) -> None:
    """Have one camera's frames rendered; returns when they are there, when ``stopped`` says so, or when the
    child failed, whose missing frames are then rendered as they are needed."""
    log.info("%s: rendering its frames ahead, once: they are kept for next time", camera)
    begin = time.perf_counter()
    child = subprocess.Popen([sys.executable, "-m", __name__], stdin=subprocess.PIPE)
    try:
        assert child.stdin is not None
        try:
            with child.stdin:
                child.stdin.write(pickle.dumps((scenario, config, camera)))
        except BrokenPipeError:
            pass  # its exit status says the same
        while child.poll() is None and not stopped():
            time.sleep(_POLL_S)
    finally:
        child.terminate()
        status = child.wait()
    if status == 0:
        log.info("%s: frames are ready after %.1f s", camera, time.perf_counter() - begin)
    elif not stopped():
        log.warning("%s: rendering ahead failed (exit %d): frames are rendered as they come", camera, status)


def _child() -> None:
    scenario, config, camera = pickle.load(sys.stdin.buffer)
    from camera_node.sources.with_effects import camera_effects
    from camera_node.synthetic.source import frame_caches

    frames = frame_caches(scenario, config, [camera], {camera: camera_effects(scenario, config, camera)})[
        camera
    ]
    frames.fill(stop=lambda: frames.disk_error is not None)
    if frames.disk_error is not None:
        sys.exit(f"camera-node: {frames.disk_error}")


if __name__ == "__main__":
    _child()
