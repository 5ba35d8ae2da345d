"""One set of weights for any number of cameras, the same in numpy and torch; probabilities of sets against all 2^N."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from edge_server.scheduler.learned import distributions as d
from edge_server.scheduler.learned import networks
from edge_server.scheduler.learned.distributions import most_probable_set, sample_sets, set_log_probability
from edge_server.scheduler.learned.explain import action_logit, explain
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.state import StateLayout
from tests.edge_server.scheduler.learned.problems import OMEGAS_MS, state
from tests.support import refused

LAYOUT = StateLayout(("age", "pose", "semantics"), dim=3)
SELECT = Spec("select", LAYOUT)
WAIT = Spec("wait", LAYOUT, OMEGAS_MS)


def actor(spec, seed=0):
    """Weights with a last layer large enough that outputs differ."""
    weights = networks.init_actor(spec, np.random.default_rng(seed))
    return {**weights, "out": 100.0 * weights["out"]}


def features(n, silent=0, seed=0, batch=5):
    rng = np.random.default_rng(seed)
    return LAYOUT.batch([state(n, rng, d=3, silent=silent) for _ in range(batch)])


def test_cameras_have_no_order_and_what_never_reported_changes_nothing():
    x, order = features(7), np.random.default_rng(1).permutation(7)
    each = networks.logits(np, SELECT, actor(SELECT), x)
    turned = networks.logits(np, SELECT, actor(SELECT), x[:, order])
    np.testing.assert_allclose(turned, each[:, order], rtol=1e-9, atol=1e-12)
    whole = networks.logits(np, WAIT, actor(WAIT), x)
    np.testing.assert_allclose(networks.logits(np, WAIT, actor(WAIT), x[:, order]), whole, rtol=1e-9, atol=1e-12)
    x = features(6, silent=2)
    for spec, keep in ((SELECT, np.s_[:, :4]), (WAIT, np.s_[:])):
        all_rows = networks.logits(np, spec, actor(spec), x)[keep]
        np.testing.assert_allclose(all_rows, networks.logits(np, spec, actor(spec), x[:, :4])[keep], rtol=1e-9)


@pytest.mark.parametrize("spec", [SELECT, WAIT])
def test_numpy_and_torch_compute_the_same(spec):
    x, weights = features(4, silent=1), actor(spec)
    tensors = {name: torch.tensor(w) for name, w in weights.items()}
    found = networks.logits(torch, spec, tensors, torch.tensor(x)).numpy()
    np.testing.assert_allclose(networks.logits(np, spec, weights, x), found, rtol=1e-12, atol=1e-12)


def test_a_specification_survives_json():
    layout = StateLayout(("age", "semantics"), dim=2, center=(0.1, 0.2), spread=(1.0, 3.0))
    spec = Spec("threshold", layout, OMEGAS_MS, learning_rate=1e-4)
    assert Spec.from_json(json.loads(json.dumps(spec.as_json()))) == spec
    assert Spec.from_json({**spec.as_json(), "network": "pooled", "cameras": None, "start": 0.5}) == spec
    for wrong in ({"network": "flat", "cameras": 4}, {"hold_ms": 10**400}):
        refused(ValueError, r"only pooled is supported|specification", Spec.from_json, {**spec.as_json(), **wrong})


def untaught(action, seed=0):
    """An actor with an opinion, though a random one."""
    actor = Learner(Spec(action, LAYOUT, () if action == "select" else OMEGAS_MS), seed).actor
    rng = np.random.default_rng(seed)
    weights = {**actor.weights, "out": 50.0 * actor.weights["out"]}
    return replace(actor, weights=weights, mean_features=rng.standard_normal(LAYOUT.width))


@pytest.mark.parametrize("action", ["select", "wait", "threshold"])
@pytest.mark.parametrize(("n", "silent"), [(1, 0), (7, 2)])
def test_shares_sum_to_the_whole(action, n, silent):
    actor, s = untaught(action), state(n, np.random.default_rng(n), d=3, silent=silent)
    found = explain(actor, s, actor.act([s])[0][0])
    assert sum(found.parts.values()) == pytest.approx(found.logit - found.baseline_logit, abs=1e-9)
    assert set(found.parts) == {"age", "pose", "semantics"}
    assert not found.cameras[n - silent :].any()
    assert abs(found.logit - found.baseline_logit) > 1e-3


def test_a_cameras_share_is_what_the_logit_falls_where_it_is_an_average_one():
    actor, s = untaught("wait"), state(2, np.random.default_rng(1), d=3)
    chosen = actor.act([s])[0][0]
    usual = LAYOUT.features(s)
    usual[1, :-1] = actor.mean_features[:-1]
    found = explain(actor, s, chosen)
    assert found.cameras[1] == pytest.approx(found.logit - action_logit(actor, usual[None], chosen)[0])


ALL = np.array(list(itertools.product((0.0, 1.0), repeat=4)))[1:]  # every non-empty set of four cameras


def every_set(logits, mask=None):
    """Log-probabilities of all non-empty sets of four cameras."""
    mask = np.ones(4) if mask is None else np.asarray(mask, float)
    rows = len(ALL)
    return set_log_probability(np, np.tile(logits, (rows, 1)), np.tile(mask, (rows, 1)), ALL)


@pytest.mark.parametrize("seed", range(2))
def test_log_probabilities_are_those_of_redrawing_until_not_empty(seed):
    logits = 2.0 * np.random.default_rng(seed).standard_normal(4)
    p = 1.0 / (1.0 + np.exp(-logits))
    each = np.prod(np.where(ALL > 0, p, 1.0 - p), axis=1)
    np.testing.assert_allclose(np.exp(every_set(logits)), each / (1.0 - np.prod(1.0 - p)), rtol=1e-12)


def test_they_sum_to_one_wherever_the_logits_are():
    about_the_bound = [-13.8, -13.9, -13.8, -60.0]  # sum of odds between the two formulas
    for logits in ([-800.0, -801.0, -802.0, -800.0], [1e4, -1e4, 0.0, 3.0], about_the_bound):
        np.testing.assert_allclose(np.exp(every_set(np.array(logits))).sum(), 1.0, rtol=1e-9)


def test_cameras_that_never_reported_are_no_part_of_it_and_with_nobody_the_empty_set_is_certain():
    logits = np.array([0.3, -0.2, 50.0, 1.0])
    logps = every_set(logits, mask=[1, 1, 0, 1])
    np.testing.assert_allclose(np.exp(logps[ALL[:, 2] == 0]).sum(), 1.0, rtol=1e-12)
    zero = np.zeros((1, 3))
    logits = torch.zeros((1, 3), dtype=torch.float64, requires_grad=True)
    logp = set_log_probability(torch, logits, torch.tensor(zero), torch.tensor(zero))
    logp.sum().backward()
    assert logp.item() == 0.0
    assert logits.grad is not None and not logits.grad.any()
    assert not sample_sets(zero, zero, np.random.default_rng(0)).any()
    assert not most_probable_set(zero, zero).any()


@pytest.mark.parametrize("scale", [1.0, 30.0, 1e4])
def test_gradients_are_finite_and_those_of_finite_differences(scale):
    values = scale * np.random.default_rng(4).standard_normal((6, 4)) - scale
    mask = np.ones((6, 4))
    mask[0, 1:] = 0.0
    chosen = np.zeros((6, 4))
    chosen[:, 0] = 1.0
    logits = torch.tensor(values, requires_grad=True)
    set_log_probability(torch, logits, torch.tensor(mask), torch.tensor(chosen)).sum().backward()
    assert logits.grad is not None
    assert torch.isfinite(logits.grad).all()
    for row, column in ((0, 0), (3, 2), (5, 0)):
        step = np.zeros_like(values)
        step[row, column] = 1e-4 * max(1.0, scale / 30.0)
        up, down = (set_log_probability(np, values + s, mask, chosen).sum() for s in (step, -step))
        slope = (up - down) / (2.0 * step[row, column])
        assert logits.grad[row, column].item() == pytest.approx(slope, abs=2e-5)


@pytest.mark.parametrize("logits", [[0.4, -1.0, -0.3, 0.9], [-6.0, -5.0, -7.0, -5.5], [-700.0, -701.0, -699.0, -702.0]])
def test_sets_are_drawn_as_often_as_their_probability_says(logits):
    logits = np.array(logits)
    count = 20_000
    drawn = sample_sets(np.tile(logits, (count, 1)), np.ones((count, 4)), np.random.default_rng(5))
    assert drawn.any(axis=1).all()
    codes = drawn @ (1 << np.arange(4))
    seen = np.bincount(codes, minlength=16)[ALL.astype(int) @ (1 << np.arange(4))] / count
    p = np.exp(every_set(logits))
    assert (np.abs(seen - p) < 4.5 * np.sqrt(p * (1 - p) / count) + 1e-9).all()


def test_the_most_probable_set_is_the_likeliest_of_all():
    for logits in np.random.default_rng(6).standard_normal((150, 4)) + np.repeat([[-3.0], [0.0], [3.0]], 50, axis=0):
        found = most_probable_set(logits[None], np.ones((1, 4)))[0]
        np.testing.assert_array_equal(found, ALL[np.argmax(every_set(logits))] > 0)


def test_entropy_of_sets_and_of_omegas():
    even = np.zeros((1, 4))
    assert d.set_entropy(np, even, np.ones((1, 4)))[0] == pytest.approx(4 * np.log(2))
    assert d.set_entropy(np, even, np.array([[1.0, 0, 0, 1.0]]))[0] == pytest.approx(2 * np.log(2))
    assert d.set_entropy(np, np.array([[1e4, -1e4, 800.0, -800.0]]), np.ones((1, 4)))[0] == 0.0
    assert d.omega_entropy(np, even)[0] == pytest.approx(np.log(4))
    certain = np.array([[0.0, -1e4, -900.0]])
    assert d.omega_entropy(np, certain)[0] == 0.0
    assert np.isfinite(d.omega_log_probabilities(np, certain)).all()
