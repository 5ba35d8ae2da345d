"""Only what the scenario calls for is imported: programs in processes of their own."""

import subprocess
import sys

import pytest

# Of each process: code, and the modules that it does not import. What loads more comes after what loads less.
CHANNEL = {
    "import channel_emu.pytest_plugin": "numpy grpc yaml msgspec channel_emu.testing channel_emu.live "
    "channel_emu.model",
    """
import freshfield as ff
ff.Channel("ch5", cameras=2).ages(1.0)
""": "channel_emu.model.faults. channel_emu.live torch numba camera_node edge_server freshfield_up",
    """
import channel_emu.cli, channel_emu.live.frame_proxy, channel_emu.testing
import channel_emu.virtual.simulate, channel_emu.estimate
""": "torch numba cv2 scipy matplotlib camera_node edge_server",
}
NODE = {
    # Without an arm.
    """
from camera_node.capture import build_cameras
from camera_node.settings import source_config
from freshfield.scenario import load
(camera,) = build_cameras(load("tile"), source_config(load("tile")), ["cam00"])
camera.capture(0)
""": "camera_node.pose camera_node.robot.flange_camera camera_node.sources.devices.live rtde "
    "depthai camera_node.synthetic.effects. camera_node.synthetic.depth camera_node.synthetic.scenes.room "
    "camera_node.synthetic.person torch numba edge_server channel_emu scipy matplotlib",
    """
import camera_node.node, camera_node.capture, camera_node.cli
import camera_node.robot.arm.hand_eye_mount, camera_node.pose.pairing
""": "camera_node.robot.teleop camera_node.robot.calibration.hand_eye.samples scipy mcap rosbags torch numba "
    "matplotlib edge_server channel_emu depthai pyrealsense2 rtde",
}
EDGE = {
    # Warm-up, which ``make`` compiles while it installs what is missing.
    """
import edge_server.fields.splat.layers.layered_field, edge_server.fields.splat.carried_camera.carried_field
import edge_server.fields.warm_up_command
""": "grpc zstandard google torch",
    # Few cameras.
    "import edge_server.fields.splat.layers.depth.depth_supervision": "edge_server.embed onnx "
    "edge_server.fields.splat.layers.depth.network_depth",
    """
import edge_server.page, edge_server.live.server, edge_server.report.build_report
import edge_server.experiments.virtual.from_scenario
from edge_server.settings import read_config
from freshfield.scenario import load
read_config(load("room"))
""": "edge_server.embed edge_server.foreground edge_server.live.depth_in_image edge_server.live.keyframes "
    "edge_server.surface edge_server.fields.splat.planar onnx skimage matplotlib mcap rosbags foxglove torch",
}


@pytest.mark.parametrize("programs", [CHANNEL, NODE, EDGE], ids=["channel", "node", "edge"])
def test_what_nobody_asks_for_is_not_imported(programs: dict[str, str]) -> None:
    code = "import sys\n"
    for program, unasked in programs.items():
        among = tuple(unasked.split())
        code += f"{program}\nprint([name for name in sys.modules if name.startswith({among})])\n"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).split() == ["[]"] * len(programs)
