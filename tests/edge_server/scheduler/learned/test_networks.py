"""One set of weights for any number of cameras, in any order; the same function in numpy and torch."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from edge_server.scheduler.learned import networks
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


def test_cameras_have_no_order():
    x, order = features(7), np.random.default_rng(1).permutation(7)
    each = networks.logits(np, SELECT, actor(SELECT), x)
    np.testing.assert_allclose(
        networks.logits(np, SELECT, actor(SELECT), x[:, order]), each[:, order], rtol=1e-9, atol=1e-12
    )
    whole = networks.logits(np, WAIT, actor(WAIT), x)
    np.testing.assert_allclose(networks.logits(np, WAIT, actor(WAIT), x[:, order]), whole, rtol=1e-9, atol=1e-12)


def test_what_never_reported_changes_nothing_for_the_others():
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
