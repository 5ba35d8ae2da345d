"""Only what the scenario calls for is imported: each program in a process of its own."""

from __future__ import annotations

import subprocess
import sys

import pytest

EDGE = """
import edge_server.page, edge_server.live.server, edge_server.report.build_report
import edge_server.experiments.virtual.from_scenario
from edge_server.settings import read_config
from freshfield.scenario import load
read_config(load("room"))
"""
NODE = """
import camera_node.node, camera_node.capture, camera_node.cli
import camera_node.robot.arm.hand_eye_mount, camera_node.pose.pairing
"""
NODE_WITHOUT_ARM = """
from camera_node.capture import build_cameras
from camera_node.settings import source_config
from freshfield.scenario import load
build_cameras(load("tile"), source_config(load("tile")), ["cam00"])
"""
TILE = """
import camera_node.synthetic.source
from camera_node.synthetic import make_scene
make_scene("tile", {"width": 16, "height": 16}).render("cam00", 0.0)
"""
FEW_CAMERAS = """
import edge_server.fields.splat.layers.layered_field
import edge_server.fields.splat.layers.depth.depth_supervision
"""
WARM_UP = """
import edge_server.fields.splat.layers.layered_field, edge_server.fields.splat.carried_camera.carried_field
import edge_server.fields.warm_up_command
"""
EMULATOR = """
import channel_emu.cli, channel_emu.live.frame_proxy, channel_emu.testing
import channel_emu.virtual.simulate, channel_emu.estimate
"""
CHANNEL = """
import freshfield as ff
ff.Channel("ch5", cameras=2).ages(1.0)
"""


UNASKED = {
    "pytest": (
        *("import channel_emu.pytest_plugin", "numpy", "grpc", "yaml", "msgspec"),
        *("channel_emu.testing", "channel_emu.live", "channel_emu.model"),
    ),
    "edge": (
        EDGE,
        *(
            f"edge_server.{room}"
            for room in ("embed", "foreground", "live.depth_in_image", "live.keyframes", "surface")
        ),
        *("edge_server.fields.splat.planar", "onnx", "skimage", "matplotlib", "mcap", "rosbags", "foxglove", "torch"),
    ),
    "node": (
        NODE,
        *("camera_node.robot.teleop", "camera_node.robot.calibration.hand_eye.samples", "scipy", "mcap", "rosbags"),
        *("torch", "numba", "matplotlib", "edge_server", "channel_emu", "depthai", "pyrealsense2", "rtde"),
    ),
    "node without an arm": (
        *(NODE_WITHOUT_ARM, "camera_node.pose", "camera_node.robot.flange_camera", "camera_node.sources.devices.live"),
        *("rtde", "depthai"),
    ),
    "tile": (
        *(TILE, "camera_node.synthetic.effects.", "camera_node.synthetic.depth", "camera_node.synthetic.scenes.room"),
        *("camera_node.synthetic.person", "torch", "numba", "edge_server", "channel_emu", "scipy", "matplotlib"),
    ),
    "few cameras": (FEW_CAMERAS, "edge_server.fields.splat.layers.depth.network_depth", "edge_server.embed", "onnx"),
    "warm-up": (WARM_UP, "grpc", "zstandard", "google", "torch"),  # ``make`` compiles while it installs them
    "library": (
        "import freshfield as ff",
        "numpy",
        "grpc",
        "edge_server",
        "camera_node",
        "channel_emu",
        "freshfield_up",
    ),
    "channel": (
        *(CHANNEL, "channel_emu.model.faults.", "channel_emu.live", "torch", "numba", "camera_node", "edge_server"),
        "freshfield_up",
    ),
    "emulator": (EMULATOR, "torch", "numba", "cv2", "scipy", "matplotlib", "camera_node", "edge_server"),
}
"""A program, and the modules that it does not import."""


@pytest.mark.parametrize("name", UNASKED)
def test_what_nobody_asks_for_is_not_imported(name: str) -> None:
    program, *unasked = UNASKED[name]
    code = f"{program}\nimport sys\nprint([name for name in sys.modules if name.startswith({tuple(unasked)})])"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"
