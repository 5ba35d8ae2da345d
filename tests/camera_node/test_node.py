"""A node as a whole: cameras that wait keep no other waiting, and its end says whether anything was taken."""

import asyncio
import threading
from fractions import Fraction
from unittest.mock import AsyncMock, MagicMock

import numpy as np
import pytest

from camera_node.capture import Camera, ShotCache
from camera_node.cli import main
from camera_node.node import Node, NodeOptions
from camera_node.outbox import Outbox
from camera_node.sender import Sender
from camera_node.settings import CameraConfig
from camera_node.sources.base import Shot, Source
from freshfield.clock import VirtualClock
from freshfield.frame import Frame
from freshfield.scenario import load
from freshfield.transport import Transport
from freshfield.v1 import frames_pb2 as pb
from tests.camera_node.depth_source import LENS, POSE, DepthSource
from tests.integration.peer import Peer, answer, silence
from tests.support import until

NOBODY = "127.0.0.1:1"


class Eye(Source):
    """A camera that takes a black picture, after ``until`` is set."""

    def __init__(self, camera: str, until: threading.Event | None = None) -> None:
        self.camera, self.fps, self.intrinsics, self._until = camera, Fraction(50), LENS, until

    def read(self, content: int) -> Shot:
        if self._until is not None:
            self._until.wait(10.0)
            raise ValueError("the camera is gone")
        return Shot(np.zeros((24, 32, 3), np.uint8), POSE, LENS)


def node_of(sources: list[Source], to: str = NOBODY, seconds: float | None = None) -> Node:
    cameras = [Camera(source, CameraConfig(kind="camera"), ShotCache(0)) for source in sources]
    return Node(load("room"), cameras, NodeOptions(to=to, transport=Transport(), seconds=seconds))


async def test_cameras_that_wait_for_their_devices_keep_no_other_waiting():
    gone = threading.Event()
    node = node_of([Eye("cam01", gone), Eye("cam02", gone), Eye("cam03")])
    running = asyncio.ensure_future(node.run())
    await until(lambda: node.outboxes and node.outboxes["cam03"].counts["captured"] >= 5, 8.0)
    waiting = gone.is_set() + sum(node.outboxes[name].counts["captured"] for name in ("cam01", "cam02"))
    gone.set()
    node.stop()
    await running
    assert waiting == 0


@pytest.mark.stability
async def test_frames_that_go_without_their_depth_are_counted():
    camera = Camera(DepthSource("cam01", 10, unit=2.0), CameraConfig(kind="camera"), ShotCache(10**6), depth_every=1)
    node = Node(load("room"), [camera], NodeOptions(to=NOBODY, transport=Transport(), seconds=0.5))
    await node.run()
    status = node.status()["cameras"]["cam01"]
    assert status["depth_failed"] == 10 and status["captured"] > 0 and status["failed"] == 0


@pytest.mark.parametrize(
    ("respond", "failure"),
    [
        (answer(pb.OUTCOME_DROPPED_BUSY), None),
        (answer(pb.OUTCOME_REJECTED, "lens"), "all frames were refused: lens "),
        (silence, None),
    ],
)
async def test_the_end_says_if_every_frame_was_refused(respond, failure):
    peer = await Peer(respond=respond).start()
    node = node_of([Eye("cam01")], peer.address)
    running = asyncio.ensure_future(node.run())
    await peer.until(3 if respond is not silence else 1)
    node.stop()
    await running
    await peer.stop()
    found = node.failure()
    assert found is failure if failure is None else found.startswith(failure)


async def test_the_end_says_if_nothing_was_captured():
    gone = threading.Event()
    gone.set()
    node = node_of([Eye("cam01", gone)], seconds=0.3)
    await node.run()
    assert node.failure().startswith("no frame could be captured (")


async def test_a_fault_of_the_program_ends_the_node_and_is_told(monkeypatch):
    """A frame that is missing is counted; what should never happen is not passed over."""
    node = node_of([Eye("cam01"), Eye("cam02")], seconds=5.0)
    monkeypatch.setattr(node, "_frame", MagicMock(side_effect=ZeroDivisionError))
    with pytest.raises(ZeroDivisionError):
        await node.run()


async def test_the_time_allowed_for_an_answer_doubles_after_each_timeout_up_to_its_bound():
    outbox = Outbox("cam01", "s", None, VirtualClock(0))
    sender = Sender(outbox, MagicMock(), (), lambda: None, np.random.default_rng(0), {}, response_timeout_s=0.05)
    sender._patience_s = 0.01
    call, allowed_s = MagicMock(write=AsyncMock(), read=asyncio.Event().wait), []
    for _ in range(4):
        with pytest.raises(TimeoutError):
            await sender._exchange(call, Frame("cam01", "s", 0, 0, POSE, LENS, "jpeg", b""))
        allowed_s.append(sender._patience_s)
    assert allowed_s == [0.02, 0.04, 0.05, 0.05] and outbox.counts["broken"] == 4
    assert not sender.connected, "it never was"


def test_a_node_that_reached_nobody_ends_with_1(capsys):
    words = ["run", "tile", "--camera", "cam01", "--to", NOBODY, "--seconds", "0.2", "--quiet"]
    assert main(words) == 1
    assert f"camera-node: {NOBODY} was never reached: " in capsys.readouterr().err
