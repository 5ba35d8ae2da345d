"""A checkpoint as a policy: what it decides is carried out as by the policies it stands beside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.live.buffer import FrameBuffer
from edge_server.live.field_updater import FieldUpdater
from edge_server.scheduler import Epoch, make_live_policy, make_policy, parse_policy
from edge_server.scheduler.learned.bandit import BanditPolicy
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.settings import Spec
from edge_server.scheduler.learned.state import State, StateLayout
from edge_server.settings import read_config
from freshfield import scenario
from tests.edge_server.fields_for_tests import tiny_field
from tests.edge_server.frames import frame

MS = 1_000_000
OMEGAS_MS = (0.0, 40.0, 80.0)


def policy(action, favourite=None, **layout):
    """A policy that prefers one omega, by the bias of its last layer."""
    omegas = () if action == "select" else OMEGAS_MS
    learner = Learner(Spec(action, StateLayout(**(layout or {"parts": ("age",)})), omegas), 1)
    actor = learner.actor
    if favourite is not None:
        actor = replace(actor, weights={**actor.weights, "out_b": 9.0 * np.eye(len(OMEGAS_MS))[favourite]})
    return BanditPolicy(actor, "bandit:test", np.random.default_rng(0))


def epoch(now_ms, **generated_ms):
    """An epoch whose state has the cameras a, b and c."""
    names = ("a", "b", "c")
    ages = np.array([now_ms - generated_ms.get(c, np.nan) for c in names])
    s = State(ages, np.zeros((3, 6)), None, np.isfinite(ages), names)
    return Epoch(now_ms * MS, 7, {c: g * MS for c, g in generated_ms.items()}, lambda parts=(): s)


AT = epoch(200, a=190, b=80, c=150)


def test_waiting_is_carried_out_as_by_omega_wait():
    p = policy("wait", favourite=1)
    plan = p.plan(AT)
    fixed = make_policy("wait", 40.0, np.random.default_rng(0))
    assert plan == fixed.plan(AT)
    later = epoch(240, a=190, b=220, c=150)
    assert p.select(later, plan) == fixed.select(later, plan) == ("b",)


def test_a_threshold_is_carried_out_as_by_omega_threshold():
    p = policy("threshold", favourite=2)
    plan = p.plan(AT)
    assert plan.omega_ms == 80.0 and plan.wait_until_ns == 0
    assert p.select(AT, plan) == ("a", "c")
    p = policy("threshold", favourite=0)
    assert p.select(AT, p.plan(AT)) == ("a",)  # none is that young: the freshest


def test_a_set_is_chosen_when_views_are_selected_and_is_never_empty():
    p = policy("select")
    actor = p.actor
    for bias, expected in ((9.0, {"a", "b"}), (-9.0, None)):
        p.actor = replace(actor, weights={**actor.weights, "out_b": np.array([bias])})
        chosen = p.select(epoch(100, a=50, b=0), p.plan(AT))
        assert set(chosen) == expected if expected else len(chosen) == 1
    assert p.last_decision is not None and p.last_decision.now_ns == 100 * MS and p.last_decision.number == 7


def test_the_shipped_policy_has_a_name_that_a_file_of_ones_own_takes_over(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = f"bandit:{scenario.SCENARIO_FOLDER / 'card/policy.npz'}"
    assert parse_policy("bandit:card/policy.npz") == (shipped, None)
    assert make_live_policy(shipped, None, np.random.default_rng(0)).name == shipped
    data = {"name": "tiny", "cameras": {"count": 3}, "edge": {"policy": {"name": "bandit:card/policy.npz"}}}
    made = scenario.parse(data, tmp_path / "tiny.yaml")
    assert read_config(made).policy.name == shipped
    (tmp_path / "card").mkdir()
    (own := tmp_path / "card/policy.npz").write_bytes(b"")
    assert parse_policy("bandit:card/policy.npz") == (f"bandit:{own}", None)
    assert read_config(made).policy.name == f"bandit:{own}"


class Brightness:
    """Embeds a picture by its mean; counts."""

    name, dim = "brightness", 1

    def __init__(self):
        self.asked = 0

    def embed(self, images):
        self.asked += len(images)
        return np.array([[image.mean()] for image in images], np.float32)


def updates(p, embedder=None):
    made = FieldUpdater(FrameBuffer(("a", "b", "c")), p, tiny_field(), start_ns=0, embedder=embedder)
    for i, camera in enumerate("ac"):
        made.buffer.put(frame(camera, i, generated_ns=10 * i * MS), 20 * MS)
    return made


def test_a_policy_is_refused_where_there_are_no_embeddings_or_others_than_it_was_taught_with():
    p = policy("select", parts=("semantics",), dim=1)
    u = updates(make_policy("all", None, np.random.default_rng(0)))
    with pytest.raises(ValueError, match=r"edge\.embedding"):
        u.policy = p
    assert u.policy.name == "all"
    with pytest.raises(ValueError, match=r"embeddings of 2 numbers, .* brightness of 1"):
        updates(policy("select", parts=("semantics",), dim=2), Brightness())
    other = policy("select", parts=("semantics",), dim=1, embedding="color")
    with pytest.raises(ValueError, match="trained with color"):
        updates(other, Brightness())
    updates(policy("select", parts=("semantics",), dim=1, embedding="brightness"), Brightness())
