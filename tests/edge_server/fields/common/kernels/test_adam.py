"""The optimizer: against torch's Adam, sparse, and deaf to what is not finite."""

from __future__ import annotations

import numpy as np
import torch

from edge_server.fields.common.kernels.adam import PARAMETER_LIMIT, Rule, adam
from edge_server.fields.common.kernels.hash_grid import SEGMENT

VERTICES = SEGMENT * 8


def _state(rng):
    table = [rng.normal(size=(VERTICES, 2)).astype(np.float32), *np.zeros((3, VERTICES, 2), np.float32)]
    net = [rng.normal(size=40).astype(np.float32), *np.zeros((3, 40), np.float32)]
    return net, table, np.zeros(VERTICES // SEGMENT, np.bool_)


def _rule(step: int, rate: float = 0.01) -> Rule:
    values = (rate, 0.9, 0.99, 1e-3, 2.0, 1 / (1 - 0.9**step), 1 / (1 - 0.99**step))
    return Rule(*(np.float32(v) for v in values))


def _step(net, table, dirty, d_params, step: int) -> int:
    dropped = np.zeros(2, np.int64)
    adam(np.zeros(1, np.int64), 0, tuple(net), (*table, dirty), d_params, _rule(step), _rule(step), dropped)
    return int(dropped.sum())


def test_equals_torch_and_touches_only_what_has_a_gradient() -> None:
    rng = np.random.default_rng(1)
    net, table, dirty = _state(rng)
    before = table[0].copy()
    names = [torch.nn.Parameter(torch.as_tensor(p.copy())) for p in (net[0], table[0][:SEGMENT])]
    oracle = torch.optim.Adam(names, lr=0.01, betas=(0.9, 0.99), eps=1e-3)
    for step in range(1, 6):
        d_params = rng.normal(size=(3, 40)).astype(np.float32)
        table[3][:SEGMENT] = rng.normal(size=(SEGMENT, 2))
        dirty[0] = True
        names[0].grad = torch.as_tensor(2.0 * d_params.sum(axis=0))
        names[1].grad = torch.as_tensor(2.0 * table[3][:SEGMENT])
        oracle.step()
        assert _step(net, table, dirty, d_params, step) == 0
    np.testing.assert_allclose(net[0], names[0].detach().numpy(), atol=1e-5)
    np.testing.assert_allclose(table[0][:SEGMENT], names[1].detach().numpy(), atol=1e-5)
    np.testing.assert_array_equal(table[0][SEGMENT:], before[SEGMENT:])
    assert not dirty.any() and (table[3] == 0).all()
    # An entry without a gradient keeps its moments.
    table[1][:], table[3][1, 0], dirty[0], before = 0.5, 1.0, True, table[0].copy()
    _step(net, table, dirty, np.zeros((1, 40), np.float32), 1)
    assert np.argwhere(table[0] != before).tolist() == [[1, 0]] and table[1][0, 0] == 0.5 != table[1][1, 0]


def test_what_is_not_finite_is_dropped_and_counted_and_broken_parameters_are_repaired() -> None:
    net, table, dirty = _state(np.random.default_rng(3))
    net[0][5] = np.nan
    d_params = np.zeros((2, 40), np.float32)
    d_params[1, 3] = np.nan
    # 3e38 doubled by the rule's scale is infinite too
    table[3][0], table[3][1], dirty[0] = (np.nan, np.inf), (1.0, 3e38), True
    table[0][2], table[0][3] = (np.nan, np.inf), (1e30, -1e30)
    before = net[0].copy(), table[0].copy()
    assert _step(net, table, dirty, d_params, 1) == 4
    before[0][5] = 0.0
    np.testing.assert_array_equal(net[0], before[0])
    np.testing.assert_array_equal(table[0][0], before[1][0])
    assert table[0][1, 0] != before[1][1, 0] and all(np.isfinite(a).all() for a in (*net, *table))
    assert (table[0][2] == 0.0).all() and table[0][3].tolist() == [PARAMETER_LIMIT, -PARAMETER_LIMIT]
