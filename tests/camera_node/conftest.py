"""A simulated arm's address."""

from __future__ import annotations

import pytest

from tests.camera_node.robot.arm.simulated import own_address, require_ur_rtde


@pytest.fixture
def host() -> str:
    """A loopback address that no other test uses; skips where the client library is missing."""
    require_ur_rtde()
    return own_address()
