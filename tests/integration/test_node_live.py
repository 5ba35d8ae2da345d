"""Frames of a real camera on their way: stamped when they were taken."""

from __future__ import annotations

import json

from camera_node.capture import build_cameras
from camera_node.node import Node, NodeOptions
from camera_node.settings import source_config
from freshfield.clock import WallClock
from freshfield.scenario import parse
from freshfield.transport import Transport
from tests.camera_node.sources.devices.mjpeg import NetworkCamera
from tests.camera_node.sources.devices.test_live import CALIBRATION
from tests.integration.peer import Peer
from tests.integration.test_node_stream import run_while


async def test_a_frame_is_as_old_as_its_camera_says(tmp_path):
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
    (camera,) = build_cameras(scenario, source_config(scenario), ["eye"])
    peer = await Peer().start()
    node = Node(scenario, [camera], NodeOptions(to=peer.address, transport=Transport()))
    await run_while(node, peer.until(5))
    await peer.stop()
    camera.source.close()
    network_camera.close()
    ages_s = [(at - frame.generated_ns) / 1e9 for frame, at in zip(peer.frames, peer.arrived_ns)]
    assert all(3.0 < age < 20.0 for age in ages_s)
    stamps = [frame.generated_ns for frame in peer.frames]
    assert stamps == sorted(set(stamps))
