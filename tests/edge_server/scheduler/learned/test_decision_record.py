"""Decisions on disk: what was decided comes back exactly, the newest are kept, damage is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.scheduler.learned.actor import Decision
from edge_server.scheduler.learned.decision_record import FOLDER, DecisionWriter, read_decision
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.settings import Spec
from edge_server.scheduler.learned.state import StateLayout
from tests.edge_server.frames import frame
from tests.edge_server.scheduler.learned.problems import state

LAYOUT = StateLayout(("age", "pose", "semantics"), dim=3)


def a_decision(number=0, seed=0, n=4, hold_ms=0.0):
    actor = Learner(Spec("select", LAYOUT, hold_ms=hold_ms), seed).actor
    s = state(n, np.random.default_rng(number), d=3, silent=1)
    s = replace(s, frames={c: frame(c, sequence=number) for c in s.cameras[:2]})
    actions, logps = actor.act([s])
    return Decision(number, 10**9 * number, s, actions[0], float(logps[0]), actor)


def names(folder, pattern="*.npz"):
    return sorted(p.name for p in folder.glob(pattern))


def test_a_decision_comes_back_as_it_was(tmp_path):
    given = a_decision(7)
    DecisionWriter(tmp_path, {"model": "default", "dim": 3}).write(given)
    found = read_decision(tmp_path, 7)
    back = found.decision
    assert (back.number, back.now_ns, back.logp) == (given.number, given.now_ns, given.logp)
    np.testing.assert_array_equal(back.action, given.action)
    for name in ("ages_ms", "poses", "embeddings", "reported"):
        np.testing.assert_array_equal(getattr(back.state, name), getattr(given.state, name))
    assert back.state.cameras == given.state.cameras
    assert back.actor.spec == given.actor.spec
    np.testing.assert_array_equal(back.actor.act([back.state])[0][0], given.action)
    assert found.embedding == {"model": "default", "dim": 3}
    assert list(found.images) == ["cam00", "cam01"]
    assert found.images["cam00"].shape == (24, 32, 3)


def test_the_oldest_make_room_and_with_them_policies_that_nobody_needs(tmp_path):
    record = DecisionWriter(tmp_path, max_decisions=3)
    for number in range(6):
        record.write(a_decision(number, seed=number // 3))
    folder = tmp_path / FOLDER
    assert names(folder, "0*") == ["000003.npz", "000004.npz", "000005.npz"]
    assert len(names(folder, "policy-*")) == 1
    again = DecisionWriter(tmp_path, max_decisions=3)  # another process of the same run goes on
    again.write(a_decision(6))
    assert names(folder, "0*") == ["000004.npz", "000005.npz", "000006.npz"]


def test_a_run_that_begins_anew_in_the_same_folder_forgets_the_earlier_one(tmp_path):
    for seed, numbers in ((0, range(4)), (1, range(2))):
        writer = DecisionWriter(tmp_path, max_decisions=4)
        for number in numbers:
            writer.write(a_decision(number, seed=seed))
    assert names(tmp_path / FOLDER, "0*") == ["000000.npz", "000001.npz"]
    assert read_decision(tmp_path).decision.number == 1


def test_a_decision_that_is_held_is_that_of_later_updates_too(tmp_path):
    record = DecisionWriter(tmp_path)
    for number in (5, 9):
        record.write(a_decision(number, hold_ms=1000.0))
    assert [read_decision(tmp_path, n).decision.number for n in (5, 8, 9, 40)] == [5, 5, 9, 9]
    record.write(a_decision(50))
    with pytest.raises(ValueError, match=r"update 51 has no decision .* that of update 50"):
        read_decision(tmp_path, 51)


def test_damage_is_named(tmp_path):
    record = DecisionWriter(tmp_path)
    record.write(a_decision(0))
    path = tmp_path / FOLDER / "000000.npz"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"000000\.npz: damaged"):
        read_decision(tmp_path, 0)
    path.write_bytes(whole)
    next((tmp_path / FOLDER).glob("policy-*")).write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"damaged: .*policy-"):
        read_decision(tmp_path, 0)
