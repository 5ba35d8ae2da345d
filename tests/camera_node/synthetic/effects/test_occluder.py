"""The occluder passes in front of training cameras, is one body for all, and leaves the truth alone."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.synthetic import make_scene
from camera_node.synthetic.effects.occluder import Occluder

SMALL = {"width": 64, "height": 64, "supersample": 1}


def make(**parameters: float) -> Occluder:
    return Occluder(**parameters)


@pytest.mark.parametrize(
    ("name", "sweep_deg", "instants"), [("room", 100.0, 24), ("tile", 100.0, 24), ("tower", 180.0, 120)]
)
def test_it_passes_in_front_of_every_camera_once_in_a_while(name, sweep_deg, instants):
    scene = make_scene(name, {**SMALL, "count": 7 if instants < 100 else 4})
    seen = make(sweep_deg=sweep_deg).extend(scene)
    assert seen.moving and seen.period_s > 1
    for camera in scene.cameras:
        covered = [
            (np.abs(seen.render(camera, t).astype(int) - scene.render(camera, t)).max(axis=-1) > 8).mean()
            for t in np.arange(instants) / instants * seen.period_s
        ]
        assert max(covered) > 0.04, camera
        assert max(covered) < 0.6, camera


def test_both_the_arm_and_the_scene_repeat_after_the_new_period():
    scene = make_scene("room", {**SMALL, "speed_m_per_s": 2.0})
    seen = make(period_s=5.0).extend(scene)
    assert seen.period_s / scene.period_s == pytest.approx(round(seen.period_s / scene.period_s))
    for t in (0.0, 0.77, 3.1):
        early, late = seen.render("cam01", t).astype(int), seen.render("cam01", t + seen.period_s)
        # The sum rounds, so a ray at an edge may fall on its other side.
        assert (np.abs(early - late).max(axis=-1) > 1).mean() < 2e-3


def test_it_hides_what_is_behind_and_is_hidden_by_what_is_in_front():
    """Swept to the far side of the target it is behind the person and the furniture: nearly invisible."""
    scene = make_scene("room", {**SMALL, "count": 2, "speed_m_per_s": 0.0})
    arm = make(period_s=4.8, sweep_deg=180.0).extend(scene)
    front, back = (
        (np.abs(arm.render("cam00", t).astype(int) - scene.render("cam00", t)).max(axis=-1) > 8).mean()
        for t in (0.0, 1.2)
    )
    assert front > 3 * back


def test_every_camera_count_sees_the_same_arm():
    """Nothing about the one body depends on who looks: entries of different runs may be shared."""
    few, many = (make().extend(make_scene("room", {**SMALL, "count": n})) for n in (2, 19))
    assert np.array_equal(few.render("cam01", 0.9), many.render("cam01", 0.9))
