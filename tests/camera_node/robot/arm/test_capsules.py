from __future__ import annotations

import numpy as np
import pytest

from camera_node.robot.arm.capsules import PAIRS, CapsuleModel, segment_distance
from camera_node.robot.arm.kinematics import UR3E

SHAPE = CapsuleModel(UR3E, 0.12, 0.04)


def test_distance_of_segments_is_the_least_of_all_their_points():
    rng = np.random.default_rng(2)
    a, b, c, d = rng.uniform(-1, 1, (4, 60, 3))
    b[:5], d[5:10] = a[:5], c[5:10]  # points
    d[10:20] = c[10:20] + (b - a)[10:20] * rng.uniform(-2, 2, (10, 1))  # parallel ones
    share = np.linspace(0, 1, 161)
    on_ab = a[:, None] + share[:, None] * (b - a)[:, None]
    on_cd = c[:, None] + share[:, None] * (d - c)[:, None]
    least = np.linalg.norm(on_ab[:, :, None] - on_cd[:, None], axis=-1).min(axis=(1, 2))
    found = segment_distance(a, b, c, d)
    assert (found <= least + 1e-12).all()
    assert (least - found).max() < 0.01


def test_parts_of_the_stretched_arm_lie_where_the_manufacturer_describes_them():
    """Along -x, the upper arm 119.8 mm and the forearm 27.3 mm aside of the joints' axes."""
    frames = UR3E.link_frames(np.zeros((1, 6)))
    a, b = (ends[0] for ends in SHAPE.segments(frames))
    height, elbow, wrist = 0.15185, -0.24355, -0.24355 - 0.2132
    np.testing.assert_allclose([a[2], b[2]], [[0, -0.1198, height], [elbow, -0.1198, height]], atol=1e-12)
    np.testing.assert_allclose([a[3], b[3]], [[elbow, -0.0273, height], [wrist, -0.0273, height]], atol=1e-12)
    # The tool is a capsule of 120 mm from the flange on; its ends are one radius inside.
    flange = np.array([wrist, -0.13105 - 0.0921, height - 0.08535])
    np.testing.assert_allclose([a[7], b[7]], np.add(flange, [[0, -0.04, 0], [0, -0.08, 0]]), atol=1e-12)
    apart, lowest = SHAPE.clearance(frames)
    # Base (radius 64 mm) and forearm (40 mm): from the top of the column to the elbow's end.
    assert apart[0][PAIRS.index((0, 3))] == pytest.approx(np.hypot(0.24355, 0.0273) - 0.064 - 0.04)
    assert lowest[0] == pytest.approx(height - 0.08535 - 0.04)
