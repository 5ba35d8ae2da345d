"""Explanations: shares sum to the whole, and what is known to have decided is what is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.scheduler.learned.explain import action_logit, explain
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.settings import Spec
from edge_server.scheduler.learned.state import StateLayout
from tests.edge_server.scheduler.learned.problems import OMEGAS_MS, state

LAYOUT = StateLayout(("age", "pose", "semantics"), dim=3)


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
