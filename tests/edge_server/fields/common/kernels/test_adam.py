"""The kernels' optimizer against torch's, their exponential, logarithm and random numbers against numpy's."""

import numpy as np
import torch
from numba import njit

from edge_server.fields.common.kernels.adam import Rule, adam
from edge_server.fields.common.kernels.hash_grid import SEGMENT
from edge_server.fields.common.kernels.jit import FAST
from edge_server.fields.common.kernels.simd import exp32, log32, uniform
from edge_server.fields.field_constants import PARAMETER_LIMIT

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


def _of_each(function):
    @njit(fastmath=FAST)
    def values(x):
        out = np.empty_like(x)
        for k in range(x.size):
            out[k] = function(x[k])
        return out

    return values


_exp, _log = _of_each(exp32), _of_each(log32)


def test_exponential_and_logarithm_are_numpys() -> None:
    x = np.linspace(-86.9, 87.9, 100_001).astype(np.float32)
    np.testing.assert_allclose(_exp(x), np.exp(x.astype(np.float64)), rtol=3e-7)
    for values in (np.exp(np.linspace(-87.0, 88.0, 100_001)), np.linspace(0.99, 1.01, 10_001)):
        x = values.astype(np.float32)
        np.testing.assert_allclose(_log(x), np.log(x.astype(np.float64)), rtol=2e-7, atol=1e-8)
    edge = _exp(np.array([-1e30, 1e30, np.nan], np.float32))
    assert 0 < edge[0] < 1e-37 and 1e38 < edge[1] < np.inf and np.isnan(edge[2])


@njit
def _draw(key, count):
    return np.array([uniform(key, np.uint64(k)) for k in range(count)])


def test_uniform_is_uniform_and_streams_differ() -> None:
    a, b = _draw(np.uint64(1), 20_000), _draw(np.uint64(2), 20_000)
    assert a.min() >= 0.0 and a.max() < 1.0 and abs(a.mean() - 0.5) < 0.01
    assert abs(np.corrcoef(a[:-1], a[1:])[0, 1]) < 0.03 and abs(np.corrcoef(a, b)[0, 1]) < 0.03
