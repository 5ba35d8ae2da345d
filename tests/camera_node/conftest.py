"""A simulated arm's address, and its factory's calibration."""

from pathlib import Path

import pytest

from tests.camera_node.robot.arm.simulated import own_address, require_ur_rtde


@pytest.fixture
def host() -> str:
    """A loopback address that no other test uses; skips where the client library is missing."""
    require_ur_rtde()
    return own_address()


# Deviations as large as real files have them: lengths along nearly parallel axes are ill-determined, so the
# factory's fit puts meters into d of joints 2 to 4 that all but cancel.
CALIBRATION = """
[mounting]
delta_theta = [ 4.1e-05, -0.0597, 0.1880, -0.1284, 1.9e-05, -3.7e-05]   # radians
delta_a = [ 3.7e-05, 4.3e-04, 1.5e-03, 3.5e-05, 5.1e-05, 0]
delta_d = [ 2.2e-04, -6.2913, 8.5694, -2.2780, -7.3e-05, 4.1e-04]
delta_alpha = [ 1.2e-04, 2.3e-03, 1.2e-02, 4.7e-04, -2.3e-04, 0]
calibration_status = 2
joint_checksum = [ 0x1, 0x2, 0x3, 0x4, 0x5, 0x6 ]
"""


@pytest.fixture
def factory(tmp_path: Path) -> Path:
    """The file of that calibration."""
    file = tmp_path / "calibration.conf"
    file.write_text(CALIBRATION)
    return file
