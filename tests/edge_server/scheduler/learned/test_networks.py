"""One set of weights for any number of cameras; the same in numpy and torch; what decided is what is named."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from edge_server.scheduler.learned import networks
from edge_server.scheduler.learned.explain import action_logit, explain
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.settings import Spec
from edge_server.scheduler.learned.state import StateLayout
from tests.edge_server.scheduler.learned.problems import OMEGAS_MS, state

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
    np.testing.assert_allclose(
        networks.logits(np, SELECT, actor(SELECT), x[:, order]), each[:, order], rtol=1e-9, atol=1e-12
    )
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
    with pytest.raises(ValueError, match="network: only pooled is read"):
        Spec.from_json({**spec.as_json(), "network": "flat", "cameras": 4})
    with pytest.raises(ValueError, match="specification"):
        Spec.from_json({**spec.as_json(), "hold_ms": 10**400})


def untaught(action, seed=0):
    """An actor with an opinion, though a random one."""
    actor = Learner(Spec(action, LAYOUT, () if action == "select" else OMEGAS_MS), seed).actor
    rng = np.random.default_rng(seed)
    return replace(
        actor,
        weights={**actor.weights, "out": 50.0 * actor.weights["out"]},
        mean_features=rng.standard_normal(LAYOUT.width),
    )


@pytest.mark.parametrize("action", ["select", "wait", "threshold"])
@pytest.mark.parametrize(("n", "silent"), [(1, 0), (7, 2)])
def test_shares_sum_to_the_whole(action, n, silent):
    actor, s = untaught(action), state(n, np.random.default_rng(n), d=3, silent=silent)
    chosen = actor.act([s])[0][0]
    found = explain(actor, s, chosen, pairs=4)
    assert sum(found.parts.values()) == pytest.approx(found.logit - found.baseline_logit, abs=1e-9)
    assert found.cameras.sum() == pytest.approx(found.logit - found.baseline_logit, abs=1e-9)
    assert set(found.parts) == {"age", "pose", "semantics"}
    assert not found.cameras[n - silent :].any()
    assert abs(found.logit - found.baseline_logit) > 1e-3


def test_cameras_of_two_are_exact():
    """With two cameras a pair of permutations is all there are."""
    actor, s = untaught("wait"), state(2, np.random.default_rng(1), d=3)
    chosen = actor.act([s])[0][0]
    found = explain(actor, s, chosen, pairs=3)
    np.testing.assert_allclose(found.cameras_error, 0.0, atol=1e-12)
    x, usual = LAYOUT.features(s), np.tile(actor.mean_features, (2, 1))
    usual[:, -1] = 1.0
    only = np.stack([np.stack([x[0], usual[1]]), np.stack([usual[0], x[1]]), usual, x])
    a, b, none, both = action_logit(actor, only, chosen)
    np.testing.assert_allclose(found.cameras, [0.5 * (a - none + both - b), 0.5 * (b - none + both - a)])
