"""A small layered scene of random Gaussians, without a fit."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.splat.layers.layer_constants import KNOTS_PER_S
from edge_server.fields.splat.layers.motion import WINDOW, Motion
from edge_server.fields.splat.layers.snapshot import LayeredSnapshot, MovingSnapshot
from freshfield.geometry import Pinhole, look_at

BOX = SceneBox((0.5, -0.2, 1.0), 2.0, 0.2, True, 3.0, 0.01)
BACKGROUND = np.array([0.2, 0.3, 0.4], np.float32)
LENS = Pinhole.from_fov(160, 120, 60.0)
POSE = look_at((0.5, -5.0, 2.2), BOX.center_m)
NEWEST_S = 10.0
ORIGIN_NS = 7_000_000_000


@cache
def gaussians(count: int, seed: int, spread: float = 0.5) -> NDArray[np.float32]:
    """Parameters (count, 14) of Gaussians about the middle."""
    rng = np.random.default_rng(seed)
    params = np.zeros((count, 14), np.float32)
    params[:, :3] = rng.normal(0.0, spread, (count, 3))
    params[:, 3:6] = rng.uniform(-4.5, -2.5, (count, 3))
    params[:, 6:10] = rng.normal(size=(count, 4))
    params[:, 10] = rng.normal(0.5, 1.5, count)
    params[:, 11:14] = rng.uniform(-0.2, 1.2, (count, 3))
    return params


@cache
def motion(anchors: int = 6) -> Motion:
    """Anchors that go about smoothly; the newest frame is at NEWEST_S."""
    rng = np.random.default_rng(2)
    found = Motion(BOX.radius_m, rng)
    found.choose_anchors(gaussians(80, 1, 0.2)[:, :3], np.ones(80), anchors, NEWEST_S - WINDOW / KNOTS_PER_S)
    found.slide(NEWEST_S)
    found._knots = np.cumsum(rng.normal(0.0, 0.03, found._knots.shape), axis=0)
    return found


def snapshot(
    static: NDArray[np.float32] | None = None, movers: int = 120, newest_s: float = NEWEST_S, box: SceneBox = BOX
) -> LayeredSnapshot:
    """What a field publishes. static: (N, 14); None: 700 Gaussians. movers: 0: nothing moves."""
    static = gaussians(700, 0) if static is None else static
    moving = None
    if movers:
        params = gaussians(movers, 1, 0.2)
        moving = MovingSnapshot(params, *motion().attach(params[:, :3], newest_s), motion(), ORIGIN_NS, newest_s)
    shown = LayeredSnapshot(box, static, BACKGROUND, CallerPool(), 0, static=static, moving=moving)
    return shown.at(None)
