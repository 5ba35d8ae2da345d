"""Only what the scenario calls for is imported: each program in a process of its own."""

import subprocess
import sys

import pytest

PROGRAMS = {
    "pytest": "import channel_emu.pytest_plugin",
    "edge": """
import edge_server.page, edge_server.live.server, edge_server.report.run_statistics
import edge_server.experiments.virtual.from_scenario
from edge_server.settings import read_config
from freshfield.scenario import load
read_config(load("room"))
""",
    "node": """
import camera_node.node, camera_node.capture, camera_node.cli
import camera_node.robot.arm.hand_eye_mount, camera_node.pose.pairing
""",
    "node without an arm": """
from camera_node.capture import build_cameras
from camera_node.settings import source_config
from freshfield.scenario import load
(camera,) = build_cameras(load("tile"), source_config(load("tile")), ["cam00"])
camera.capture(0)
""",
    "few cameras": """
import edge_server.fields.splat.layers.layered_field
import edge_server.fields.splat.layers.depth.depth_supervision
""",
    "warm-up": """
import edge_server.fields.splat.layers.layered_field, edge_server.fields.splat.carried_camera.carried_field
import edge_server.fields.warm_up_command
""",
    "channel": """
import freshfield as ff
ff.Channel("ch5", cameras=2).ages(1.0)
""",
    "emulator": """
import channel_emu.cli, channel_emu.live.frame_proxy, channel_emu.testing
import channel_emu.virtual.simulate, channel_emu.estimate
""",
}
UNASKED = {
    "pytest": "numpy grpc yaml msgspec channel_emu.testing channel_emu.live channel_emu.model",
    "edge": "edge_server.embed edge_server.foreground edge_server.live.depth_in_image edge_server.live.keyframes "
    "edge_server.surface edge_server.fields.splat.planar onnx skimage matplotlib mcap rosbags foxglove torch",
    "node": "camera_node.robot.teleop camera_node.robot.calibration.hand_eye.samples scipy mcap rosbags torch numba "
    "matplotlib edge_server channel_emu depthai pyrealsense2 rtde",
    "node without an arm": "camera_node.pose camera_node.robot.flange_camera camera_node.sources.devices.live rtde "
    "depthai camera_node.synthetic.effects. camera_node.synthetic.depth camera_node.synthetic.scenes.room "
    "camera_node.synthetic.person torch numba edge_server channel_emu scipy matplotlib",
    "few cameras": "edge_server.fields.splat.layers.depth.network_depth edge_server.embed onnx",
    "warm-up": "grpc zstandard google torch",  # ``make`` compiles while it installs them
    "channel": "channel_emu.model.faults. channel_emu.live torch numba camera_node edge_server freshfield_up",
    "emulator": "torch numba cv2 scipy matplotlib camera_node edge_server",
}
"""A program's name, and the modules that it does not import."""


@pytest.mark.parametrize("name", UNASKED)
def test_what_nobody_asks_for_is_not_imported(name: str) -> None:
    unasked = tuple(UNASKED[name].split())
    code = f"{PROGRAMS[name]}\nimport sys\nprint([name for name in sys.modules if name.startswith({unasked})])"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


@pytest.mark.parametrize("first", ["freshfield as ff\nff.load", "camera_node.robot.calibration.inputs"])
def test_opencv_has_its_bound_whoever_imports_it_first(first: str) -> None:
    code = f"import {first}\nimport cv2, numpy\ncv2.imdecode(numpy.frombuffer(b'P5 5000 5000 255 ', numpy.uint8), 0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "CV_IO_MAX_IMAGE_PIXELS" in done.stderr
