"""Motion is periodic, smooth and as fast as asked; feet stand still while they stand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node.synthetic import motion, person

WALK = person.Walk((0.0, 1.0), (0.7, 0.5), 4.8)


def test_phase_stays_in_range_and_refuses_what_is_not_a_time():
    for t in (0.0, -1e-18, -1.0, 4.8, 4.8 * 7, 1e9, -1e9, 1e17):
        assert 0.0 <= motion.phase_of(t, 4.8) < 1.0
    for t in (np.nan, np.inf, -np.inf):
        with pytest.raises(ValueError, match="finite"):
            motion.phase_of(t, 4.8)


@given(st.floats(0, 1, exclude_max=True))
def test_the_person_joins_up_at_the_end_of_the_loop(phase):
    for a, b in zip(person.bones(WALK, phase), person.bones(WALK, phase + 1.0)):
        assert np.allclose(a, b, atol=1e-9)


@pytest.mark.parametrize("speed", [0.05, 1.0, 8.0])
def test_mean_speed_of_the_parts_is_the_one_asked_for(speed):
    """Measured independently: middles of all parts, by finite differences over one period in seconds."""
    walk = person.make_walk((0.0, 1.0), (0.74, 0.54), speed)
    assert (walk.period_s / motion.PERIOD_UNIT_S) == pytest.approx(round(walk.period_s / motion.PERIOD_UNIT_S))
    body = person.walking_person(walk)
    n = 400
    centers = []
    for k in range(n + 1):
        m = body.matrices(walk.period_s * k / n)
        local = np.stack([p.shape.bounding_sphere()[0] for p in body.parts])
        centers.append((m[:, :3, :3] @ local[:, :, None])[:, :, 0] + m[:, :3, 3])
    meters = np.linalg.norm(np.diff(np.stack(centers), axis=0), axis=2).sum(axis=0).mean()
    assert meters / walk.period_s == pytest.approx(speed, rel=0.03)


@given(st.tuples(*[st.floats(-1, 1)] * 3), st.tuples(*[st.floats(-1, 1)] * 3), st.tuples(*[st.floats(-1, 1)] * 3))
def test_two_bones_meet_the_joint(root, tip, pole):
    upper, lower = 0.6, 0.5
    assert motion.two_bone_ik(root, root, upper, lower, (0.0, 0.0, 1.0)) == (root[0], root[1], root[2] + upper)
    joint = np.array(motion.two_bone_ik(root, tip, upper, lower, pole))
    assert np.isfinite(joint).all()
    distance = float(np.linalg.norm(np.subtract(tip, root)))
    # Within reach, with a pole that is not along the limb, both bones have their lengths.
    across = np.cross(np.subtract(tip, root), pole)
    if 0.11 < distance < 0.98 and np.linalg.norm(across) > 1e-3:
        assert np.linalg.norm(joint - root) == pytest.approx(upper, rel=1e-6)
        assert np.linalg.norm(joint - tip) == pytest.approx(lower, rel=1e-6)


def test_bone_frames_are_rotations_even_along_their_side_vector():
    start = np.zeros((4, 3))
    end = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0], [0, 0, 0]])
    side = np.array([[1, 0, 0], [1.0, 0, 0], [0, 1, 0], [1, 0, 0]])
    frames = motion.bone_frames(start, end, side)
    assert np.isfinite(frames).all()
    for k in range(4):
        r = frames[k, :3, :3]
        assert np.allclose(r @ r.T, np.eye(3)) and np.linalg.det(r) == pytest.approx(1.0)
        assert k == 3 or np.allclose(r[:, 2], end[k])
