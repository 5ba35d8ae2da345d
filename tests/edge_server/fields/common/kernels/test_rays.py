"""Pixel to ray, and ray to samples: against ``freshfield.geometry`` and a plain march in torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numba import njit

from edge_server.fields.common.kernels.rays import HORIZON, NEVER, Space, interval, march, pixel_direction
from edge_server.fields.common.supervision import lens_row
from freshfield.geometry import Pinhole, look_at

_direction = njit(lambda lens, rotation, u, v: pixel_direction(lens, rotation, u, v))
_interval = njit(lambda space, o, d: interval(space, o, d))

CELLS = 16


def _space(contracted: bool, filled: float) -> Space:
    rng = np.random.default_rng(5)
    occupied = (rng.random(CELLS**3) < filled).astype(np.uint8)
    blocks = occupied.reshape([4, 4, 4, 4, 4, 4]).max(axis=(1, 3, 5)).reshape(-1)
    density = np.full(CELLS**3, 1.5, np.float32)
    return Space(occupied, blocks, density, CELLS, contracted, np.float32(2 * 3**0.5 / 32), np.float32(0.1))


def _march(space: Space, o, d, jitter: float = 0.0, room=slice(0, 500), opaque=NEVER):
    """Places (3, N), distances and lengths (N,) of the samples in ``room``, where the march ended, and its depth."""
    x, ts, dts = np.zeros((3, 500), np.float32), np.zeros(500, np.float32), np.zeros(500, np.float32)
    o, d = (tuple(map(np.float32, v)) for v in (o, d))
    enter, leave = map(np.float32, _interval(space, o, d))
    first = np.float32(enter + np.float32(jitter) * space.step)
    n, t, depth = march(space, o, d, first, leave, x, ts, dts, room.start, room.stop, opaque)
    assert (x[:, : room.start] == 0).all() and (n < room.stop or t < leave)
    return x[:, room.start : n], ts[room.start : n], dts[room.start : n], depth


@pytest.mark.parametrize("distortion", [(0, 0, 0, 0), (0.06, -0.08, -0.001, 0.0002)])
def test_directions_are_those_of_the_pinhole_camera(distortion: tuple) -> None:
    camera = Pinhole(40, 30, 35.0, 36.0, 19.0, 16.0, distortion)
    pose = look_at((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
    expected = camera.rays() @ pose[:3, :3].T
    lens, rotation = np.array(lens_row(camera)), np.ascontiguousarray(pose[:3, :3])
    for u, v in ((0, 0), (39, 29), (11, 23)):
        got = _direction(lens, rotation, u + 0.5, v + 0.5)
        np.testing.assert_allclose(got, expected[v, u], atol=2e-7)


def _march_oracle(space: Space, o: torch.Tensor, d: torch.Tensor, jitter: float):
    """A ray's distances, lengths, unit-cube points and which of them lie in occupied cells, without skipping."""
    step, half = float(space.step), HORIZON if space.contracted else 1.0
    safe = torch.where(d.abs() < 1e-9, torch.full_like(d, 1e-9), d)
    a, b = (-half - o) / safe, (half - o) / safe
    t, leave = torch.minimum(a, b).amax().clamp(min=float(space.near)) + jitter * step, torch.maximum(a, b).amin()
    ts, deltas = [], []
    while t < leave:
        size = (o + t * d).abs().amax().clamp(min=1.0) if space.contracted else torch.tensor(1.0)
        ts.append(t)
        deltas.append(step * size.square())
        t = t + deltas[-1]
    ts, deltas = (torch.stack(values) if values else torch.zeros(0) for values in (ts, deltas))
    p = o + ts[:, None] * d
    if space.contracted:
        m = p.abs().amax(-1, keepdim=True).clamp(min=1.0)
        p = p * (2.0 - 1.0 / m) / m * 0.5
    u = (p * 0.5 + 0.5).clamp(0.0, 0.9999999)
    cell = (u * CELLS).long()
    occupied = torch.as_tensor(space.occupied).view(CELLS, CELLS, CELLS)
    return ts, deltas, u, occupied[cell[:, 2], cell[:, 1], cell[:, 0]] > 0


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("filled", [1.0, 0.02])
def test_samples_equal_the_oracle(contracted: bool, filled: float) -> None:
    space = _space(contracted, filled)
    rng = np.random.default_rng(6)
    from_inside = missing = 0
    for k in range(30):
        o = rng.normal(size=3) * 1.5
        d = rng.uniform(-0.6, 0.6, 3) - o if k < 20 else rng.normal(size=3)
        d /= np.linalg.norm(d)
        x, ts, dts, _ = _march(space, o, d, 0.3)
        t, delta, u, inside = _march_oracle(space, *(torch.as_tensor(a, dtype=torch.float32) for a in (o, d)), 0.3)
        # Both add up distances in float32, in another order: borders of cells may fall either way.
        got, wanted = set(np.round(ts, 3)), set(np.round(t[inside].numpy(), 3))
        assert len(got ^ wanted) <= max(2, 0.1 * len(wanted))
        same = np.isin(np.round(ts, 3), list(wanted))
        rows = [int((t - ts[k]).abs().argmin()) for k in np.flatnonzero(same)]
        np.testing.assert_allclose(x[:, same].T, u[rows].numpy(), atol=2e-4)
        np.testing.assert_allclose(dts[same], delta[rows].numpy(), rtol=2e-3)
        from_inside += np.abs(o).max() < 1.0  # begins at the near plane
        missing += not len(t)
    assert from_inside and (missing or contracted)


def test_a_ray_ends_where_the_room_does_or_the_known_density_makes_it_opaque() -> None:
    way, space = (np.array([-3.0, 0.1, 0.1]), np.array([1.0, 0.0, 0.0])), _space(False, 1.0)
    assert _march(_space(False, 0.0), *way)[1].size == 0, "empty space is skipped"
    whole = _march(space, *way)[1]
    np.testing.assert_array_equal(_march(space, *way, room=slice(4, 9))[1], whole[:5])
    _, seen, _, depth = _march(space, *way, opaque=np.float32(1.0))
    np.testing.assert_array_equal(seen, whole[: int(np.ceil(1.0 / (1.5 * space.step)))])
    assert depth > 1.0 and len(seen) < len(whole)
