"""Three hundred updates of a moving scene, warm starts only, against fields fitted afresh."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from camera_node.synthetic import make_scene
from edge_server.fidelity.psnr import psnr
from edge_server.fields import Budget, View
from edge_server.fields.splat.field import StillField
from edge_server.fields.splat.settings import SplatSettings

pytestmark = pytest.mark.stability

UPDATES, FRESH_TIMES, NEAR_DB = 300, 15, 0.2
STILL = 6  # of 255: what changes by less over half a second stands still
LAST = range(UPDATES - 9, UPDATES + 1)


@pytest.mark.slow
def test_three_hundred_updates_later_a_field_is_as_good_as_a_fresh_one() -> None:
    """Of Gaussians: room is made for new ones at every update, and what stands still must outlast it."""
    scene, steps = make_scene("room", {"count": 13, "width": 48, "height": 48, "speed_m_per_s": 1.0}), 20

    @cache
    def views(frame: int) -> list[View]:
        at_s = frame / 15.0
        return [
            View(c, scene.render(c, at_s), pose, lens, round(1e9 * at_s)) for c, (lens, pose) in scene.cameras.items()
        ]

    def fresh(frame: int) -> StillField:
        field = StillField(SplatSettings(gaussians=2048, start=1024))
        field.fit(views(frame)[1:], Budget(steps=FRESH_TIMES * steps))
        return field

    def psnr_db(field: StillField, frame: int, still: bool = True) -> float:
        """Of the camera that is held out: on what stands still, or on all."""
        view, *earlier = (views(k)[0] for k in (frame, frame - 4, frame - 8))
        changes = [np.abs(view.image.astype(int) - e.image).max(axis=-1) for e in earlier]
        shown = field.render(view.camera_to_world, view.intrinsics).color
        return psnr(shown, view.image / 255.0, np.max(changes, axis=0) < STILL if still else None)

    follower, followed = fresh(0), []
    for frame in range(1, UPDATES + 1):
        follower.fit(views(frame)[1:], Budget(steps=steps))
        if frame in LAST:
            followed.append(psnr_db(follower, frame))
    known = [psnr_db(fresh(frame), frame) for frame in LAST[::3]]
    assert np.mean(followed) > np.mean(known) - NEAR_DB, (followed, known)
    never_db = psnr_db(fresh(0), UPDATES, still=False)
    assert psnr_db(follower, UPDATES, still=False) > never_db + 1.0, "nothing moved: nothing was tested"
