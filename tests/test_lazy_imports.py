"""Only what the scenario calls for is imported: each program in a process of its own."""

from __future__ import annotations

import subprocess
import sys

import pytest

# What is done, and what must not be imported by it.
UNASKED = {
    "import channel_emu.pytest_plugin": (
        "numpy grpc yaml msgspec channel_emu.testing channel_emu.live channel_emu.model"
    ),
    "import edge_server.page, edge_server.live.server, edge_server.report.build_report\n"
    "import edge_server.experiments.virtual.from_scenario\n"
    "from edge_server.settings import read_config; from freshfield.scenario import load; read_config(load('room'))": (
        "edge_server.embed edge_server.foreground edge_server.live.depth_in_image edge_server.live.keyframes "
        "edge_server.surface edge_server.fields.splat.planar onnx skimage matplotlib mcap rosbags foxglove torch"
    ),
    "import camera_node.node, camera_node.capture, camera_node.cli\n"
    "import camera_node.robot.arm.hand_eye_mount, camera_node.pose.pairing": (
        "camera_node.robot.teleop camera_node.robot.calibration.hand_eye.samples scipy mcap rosbags torch numba "
        "matplotlib edge_server channel_emu depthai pyrealsense2 rtde"
    ),
    "from camera_node.capture import build_cameras; from camera_node.settings import source_config\n"
    "from freshfield.scenario import load; tile = load('tile')\n"
    "build_cameras(tile, source_config(tile), ['cam00'])": (
        "camera_node.pose camera_node.robot.flange_camera camera_node.sources.devices.live rtde depthai"
    ),
    "import camera_node.synthetic.source; from camera_node.synthetic import make_scene\n"
    "make_scene('tile', {'width': 16, 'height': 16}).render('cam00', 0.0)": (
        "camera_node.synthetic.scenes.room camera_node.synthetic.person torch numba edge_server channel_emu scipy "
        "matplotlib"
    ),
    "import edge_server.fields.splat.layers.layered_field\n"
    "import edge_server.fields.splat.layers.depth.depth_supervision": (
        "edge_server.fields.splat.layers.depth.network_depth edge_server.embed onnx"
    ),
    # ``make`` compiles while it installs these.
    "import edge_server.fields.splat.layers.layered_field, edge_server.fields.splat.scan.carried_field\n"
    "import edge_server.fields.warm_up_command": "grpc zstandard google torch",
    "import freshfield": "numpy grpc camera_node channel_emu edge_server freshfield_up",
    "import freshfield as ff; ff.Channel('ch5', cameras=2).ages(1.0)": (
        "torch numba camera_node edge_server channel_emu.live freshfield_up"
    ),
    "import channel_emu.cli, channel_emu.live.frame_proxy, channel_emu.testing\n"
    "import channel_emu.virtual.simulate, channel_emu.estimate": (
        "torch numba cv2 scipy matplotlib camera_node edge_server"
    ),
}


@pytest.mark.parametrize(("program", "unasked"), UNASKED.items(), ids=lambda text: text.split(",")[0][:60])
def test_what_nobody_asks_for_is_not_imported(program: str, unasked: str) -> None:
    names = tuple(unasked.split())
    code = f"{program}\nimport sys\nprint([name for name in sys.modules if name.startswith({names})])"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"
