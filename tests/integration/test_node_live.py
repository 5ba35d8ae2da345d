"""Frames of real cameras and of an arm's camera on their way: stamped when they were taken."""

from __future__ import annotations

import asyncio
import dataclasses
import json

from camera_node.capture import build_cameras
from camera_node.node import Node, NodeOptions
from camera_node.settings import source_config
from freshfield.clock import WallClock
from freshfield.scenario import load, parse
from freshfield.transport import Transport
from tests.camera_node.robot.arm.simulated import own_address, require_ur_rtde, simulated_arm
from tests.camera_node.sources.devices.mjpeg import NetworkCamera
from tests.camera_node.sources.devices.test_live import CALIBRATION
from tests.integration.peer import Peer


def frames_of(scenario, wanted, count):
    """What a node sends, from ``count`` frames of each camera ``wanted`` on, and when each frame arrived."""

    async def scene():
        peer = await Peer().start()
        cameras = build_cameras(scenario, source_config(scenario), wanted)
        node = Node(scenario, cameras, NodeOptions(to=peer.address, transport=Transport()))
        running = asyncio.ensure_future(node.run())
        try:
            await peer.until_each(wanted, count)
        finally:
            node.stop()
            await running
            await peer.stop()
        for camera in cameras:
            getattr(camera.source, "close", lambda: None)()
        return peer.frames, peer.arrived_ns

    return asyncio.run(scene())


def test_a_frame_is_as_old_as_its_camera_says(tmp_path):
    network_camera = NetworkCamera(WallClock())
    (tmp_path / "calibration.json").write_text(json.dumps(CALIBRATION))
    source = {
        "kind": "camera",
        "devices": {"eye": network_camera.address},
        "calibration": "calibration.json",
        "fps": 10,
        "latency_ms": 3000.0,
    }
    scenario = parse({"cameras": {"ids": ["eye"]}, "source": source}, tmp_path / "scenario.yaml")
    frames, arrived_ns = frames_of(scenario, ["eye"], 5)
    network_camera.close()
    ages_s = [(at - frame.generated_ns) / 1e9 for frame, at in zip(frames, arrived_ns)]
    assert all(3.0 < age < 20.0 for age in ages_s)
    stamps = [frame.generated_ns for frame in frames]
    assert stamps == sorted(set(stamps))


def test_frames_from_a_hand_carry_their_gap_to_the_arms_state():
    require_ur_rtde()
    host, cell = own_address(), load("cell")
    arm = {**cell.source["arm"], "host": host, "max_gap_ms": 2000.0, "pairing": "nearest"}
    small = {"width": 32, "height": 32, "params": {"supersample": 1}, "fps": 10}
    scenario = dataclasses.replace(cell, source={**cell.source, **small, "arm": arm})
    with simulated_arm(host):
        frames, _ = frames_of(scenario, ["hand"], 5)
    assert all(0 <= frame.pose_gap_ns <= 2_000_000_000 for frame in frames)
    assert any(frame.pose_gap_ns for frame in frames) and not any(frame.held_out for frame in frames)
