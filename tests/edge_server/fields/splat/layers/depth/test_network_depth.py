"""A depth network of the user's fills what stereo and sensors leave out, where it agrees with them."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.threads.thread_pool import shared_pool
from edge_server.fields.splat.layers.depth.network_depth import NetworkDepth
from edge_server.fields.splat.layers.depth.surfaces import Surface
from edge_server.fields.splat.layers.layered_field import LayeredField
from tests.edge_server.fields.small import same_state
from tests.edge_server.fields.splat.layers.ball import SMALL, Rig
from tests.edge_server.fields.splat.layers.depth.room_plates import relative_of, room_plates
from tests.edge_server.fields.splat.layers.depth.test_stereo_and_registration import filled

Image = NDArray[np.float32]
NAMES = ["cam01", "cam02", "cam03"]


class OfPlates:
    """A network that knows plates: those of ``room_plates`` or others, by their color."""

    def __init__(self, plates: list[Surface], relative: list[Image]) -> None:
        self.known = {p.color.astype(np.uint8).tobytes(): r for p, r in zip(plates, relative)}

    def __call__(self, image: NDArray[np.uint8]) -> Image:
        if image.tobytes() not in self.known:
            raise ValueError("an unknown image")
        return self.known[image.tobytes()]


@cache
def _stereo() -> tuple[list[Surface], list[Surface], NDArray[np.float64]]:
    """Plates of three cameras before and after stereo, and their true depths."""
    plates, depths = room_plates(3)
    return plates, filled(plates), depths


def _filled(network: NetworkDepth, surfaces: list[Surface], sensor: list[NDArray[np.bool_]]) -> list[Surface]:
    return network.fill(NAMES, surfaces, sensor, shared_pool())


def _right(surface: Surface, depth_m: NDArray[np.float64], where: NDArray[np.bool_] | None = None) -> float:
    """Share of pixels whose depth is within 10 %."""
    found = surface.depth()
    return float((np.abs(np.log(np.maximum(found, 1e-3) / depth_m)) < 0.1)[... if where is None else where].mean())


def test_it_fills_what_stereo_has_not_found_and_mends_what_it_has_found_wrongly() -> None:
    plates, surfaces, depths = _stereo()
    network = NetworkDepth(OfPlates(plates, [relative_of(z, k) for k, z in enumerate(depths)]))
    found = _filled(network, surfaces, [np.zeros(p.known.shape, bool) for p in plates])
    before = [_right(s, z) for s, z in zip(surfaces, depths)]
    after = [_right(s, z) for s, z in zip(found, depths)]
    assert before == pytest.approx([0.61, 0.37, 0.88], abs=0.05)
    # Of the second camera's stereo too little is right to say whether the network is.
    assert list(network.refused) == ["cam02"] and found[1] is surfaces[1]
    assert after[0] > 0.66 and after[2] > 0.93
    assert all(np.isfinite(s.inverse).all() and np.isfinite(s.slope).all() for s in found)


def test_what_a_sensor_has_measured_stays_and_tells_scale_and_shift_to_cameras_without() -> None:
    plates, depths = room_plates(3)
    half = np.zeros(plates[0].known.shape, bool)
    half[:, 24:] = True
    inverse = np.where(half, 1.0 / depths[0], 0.0).astype(np.float32)
    surfaces = [replace(plates[0], inverse=inverse), *plates[1:]]
    network = NetworkDepth(OfPlates(plates, [relative_of(z, k) for k, z in enumerate(depths)]))
    found = _filled(network, surfaces, [s.inverse > 0 for s in surfaces])
    assert (found[0].inverse[half] == inverse[half]).all() and _right(found[0], depths[0], ~half) > 0.95
    for k in (1, 2):  # of these nothing is known but what the first camera sees of the same surfaces
        assert NAMES[k] not in network.refused and _right(found[k], depths[k]) > 0.8


_RNG = np.random.default_rng(1)
_RELATIVE: dict[str, Callable[[Image], Image]] = {
    "depth, not its inverse": lambda r: 1.0 / r,
    "upside down": lambda r: r[::-1],
    "zero": np.zeros_like,
    "noise": lambda r: _RNG.random(r.shape).astype(np.float32),
    "NaN": lambda r: np.full_like(r, np.nan),
    "huge": lambda r: np.where(r > np.median(r), np.float32(1e38), np.float32(-1e38)),
    "none of this image": lambda r: r,
}


@pytest.mark.stability
@pytest.mark.parametrize("kind", _RELATIVE)
def test_a_network_that_fails_is_left_unused_and_named(kind: str) -> None:
    """Or one that does not agree with what is known."""
    plates, surfaces, depths = _stereo()
    relative = [_RELATIVE[kind](relative_of(z, k)).astype(np.float32) for k, z in enumerate(depths)]
    network = NetworkDepth(OfPlates([] if kind == "none of this image" else plates, relative))
    found = _filled(network, surfaces, [np.zeros(p.known.shape, bool) for p in plates])
    assert all(a is b for a, b in zip(found, surfaces)) and list(network.refused) == NAMES
    assert all(any(w in why for w in ("agree with it", "too few", "unknown")) for why in network.refused.values())


# --- in the field: a ball, of which sensors see the left --------------------------------------------

RIG = Rig((0, 2, 4), held=1)


def _measured(camera: int, frame: int, view: View) -> View:
    """The sky is a wall 6 m away."""
    wall = np.where(view.depth > 0, view.depth, np.float32(6.0))
    return replace(view, depth=np.where(np.arange(48) < 32, wall, np.float32(0.0)))


def _of_the_ball(image: NDArray[np.uint8]) -> Image:
    """What a network says of the camera whose image is most like this one."""
    views = [RIG.frame(k, 0) for k in range(3)]
    k = int(np.argmin([np.mean(np.abs(v.image.astype(float) - image) > 40.0) for v in views]))
    return relative_of(np.where(views[k].depth > 0, views[k].depth, 6.0), k)


def test_the_field_learns_it_and_resumes_bit_for_bit() -> None:
    field, without, other = LayeredField(SMALL), LayeredField(SMALL), LayeredField(SMALL)
    field.use_depth_network(_of_the_ball)
    for each in (field, without):
        RIG.run(each, range(16), _measured, steps=5)
    assert field.supervision.with_depth and not field.troubles
    seen_m = [each.supervision.depth.scene.meshes.depth for each in (field, without)]
    assert np.count_nonzero(seen_m[0]) > 1.4 * np.count_nonzero(seen_m[1])
    other.load_state(field.state())
    other.use_depth_network(_of_the_ball)
    field.load_state(field.state())
    assert field.supervision.network is not None, "a field keeps the network that it was given"
    same_state(*(RIG.run(each, range(16, 24), _measured, steps=5) for each in (field, other)))
