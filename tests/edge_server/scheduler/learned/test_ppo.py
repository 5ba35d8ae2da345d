"""Learning happens, on bandits whose optimum is known; the same seed gives the same weights; nothing is lost
in a checkpoint."""

from __future__ import annotations

import re
import zipfile
from dataclasses import replace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from edge_server.fields import checkpoint
from edge_server.scheduler.learned import distributions as d
from edge_server.scheduler.learned import networks
from edge_server.scheduler.learned.actor import MAX_BYTES, Actor
from edge_server.scheduler.learned.clipped_update import Acted, clipped_update
from edge_server.scheduler.learned.ppo import Learner, _RunningMeanStd
from edge_server.scheduler.learned.settings import Spec
from tests.edge_server.scheduler.learned.problems import OMEGAS_MS, FreshOnes, Waits, collect, regret, state, teach


def same(a: Learner, b: Learner) -> bool:
    mine, other = a.actor.weights, b.actor.weights
    return all(np.array_equal(mine[name], other[name]) for name in mine)


def select(**more) -> Spec:
    return Spec("select", FreshOnes.layout, **more)


WAIT = Spec("wait", Waits.layout, OMEGAS_MS)


@pytest.mark.parametrize(("problem", "spec"), [(FreshOnes(), select()), (Waits(), WAIT)], ids=["sets", "omegas"])
def test_512_decisions_are_enough_to_learn_from(problem, spec):
    """A random set loses .35, an untrained network .01 to .6 of a gain of .5; noise of a reward is .1. A random omega
    loses .104, the best fixed one .05."""
    learner = Learner(spec, 0)
    teach(learner, problem, 8)
    assert regret(learner, problem) < 0.02


def test_a_batch_of_one_decision_learns_against_the_value():
    """Algorithms 1 and 2 update after every slot: centered by its batch, an advantage would be zero."""
    learner = Learner(WAIT, 0)
    teach(learner, Waits(), 1)
    for better in (1.0, -1.0):
        states = [Waits().draw(77).state]
        actions, before = learner.act(states)
        worth = learner.value(states) + better
        learner.update(learner.batch(states, actions, before, worth))
        after = d.omega_log_probabilities(np, learner.actor.logits(learner.spec.layout.batch(states)))
        assert better * (after[0, actions[0]] - before[0]) > 0.0


def test_a_checkpoint_goes_on_bit_for_bit(tmp_path):
    through, stopped = Learner(select(), 3), Learner(select(), 3)
    teach(through, FreshOnes(), 4)
    teach(stopped, FreshOnes(), 2)
    stopped.save(tmp_path / "policy.npz")
    resumed = Learner.load(tmp_path / "policy.npz")
    for number in (2, 3):
        resumed.update(collect(resumed, FreshOnes(), range(64 * number, 64 * (number + 1))))
    assert same(through, resumed)
    assert (resumed.updates, resumed.decisions) == (4, 256)
    s = [state(6, np.random.default_rng(0))]
    assert through.value(s) == resumed.value(s)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """The file of a learner that has been taught once."""
    learner = Learner(select(), 0)
    teach(learner, FreshOnes(), 1)
    learner.save(path := tmp_path_factory.mktemp("saved") / "policy.npz")
    return path


def refused_by(load, path, match: str | None = None) -> None:
    """In one line that names the file once."""
    with pytest.raises(checkpoint.CheckpointError, match=match) as refused:
        load(path)
    assert str(refused.value).count(str(path)) == 1 and "\n" not in str(refused.value)


def edited(source, folder, change):
    """Another checkpoint, with arrays and metadata changed."""
    arrays, about = checkpoint.load(source, kind="scheduler")
    change(arrays, about)
    checkpoint.save(folder / "policy.npz", arrays, about, kind="scheduler")
    return folder / "policy.npz"


def _fact(key, value):
    return lambda arrays, about: about.update({key: value})


def _array(name, change):
    return lambda arrays, about: arrays.update({name: change(arrays[name])})


def _spec(**changed):
    return lambda arrays, about: about["spec"].update(changed)


def _filled(name, value):
    return _array(name, lambda array: np.full_like(array, value))


def _cut(name):
    return _array(name, lambda array: array.T[..., :1])


WHOLES = {
    "nan": lambda arrays, about: arrays["actor.in"].__setitem__((0, 0), np.nan),
    "shape": _array("actor.in", lambda array: array[:, 1:]),
    "words": _array("actor.in", lambda array: array.astype(str)),
    "lacks": lambda arrays, about: arrays.pop("actor.out"),
    "action": _spec(action="guess"),
    "key": _spec(depth=3),
}


@pytest.mark.parametrize("damage", ["cut", "field", *WHOLES])
def test_a_file_that_is_no_whole_checkpoint_is_refused_in_one_line(tmp_path, saved, damage):
    if damage in WHOLES:
        path = edited(saved, tmp_path, WHOLES[damage])
    elif damage == "cut":
        (path := tmp_path / "policy.npz").write_bytes(saved.read_bytes()[:-200])
    else:
        checkpoint.save(path := tmp_path / "policy.npz", {"a": np.zeros(3)})
    for load in (Learner.load, Actor.load):
        refused_by(load, path, f"^{re.escape(str(path))}")


LARGE = {"hidden": {"hidden": 30_000}, "dim": {"layout": {"parts": ["age", "semantics"], "dim": 10**9}}}
WRONG = {
    "hidden is text": {"hidden": "64"},
    "minibatch is no whole number": {"minibatch": 1.5},
    "omegas fall": {"action": "wait", "omegas_ms": [50.0, 0.0]},
    "waits too long": {"action": "wait", "omegas_ms": [0.0, 1e308]},
    "learning rate is no number": {"learning_rate": float("nan")},
    "center is infinite": {"layout": {"parts": ["semantics"], "dim": 1, "center": [np.inf], "spread": [1.0]}},
}


@pytest.mark.parametrize("change", [*LARGE.values(), *WRONG.values()], ids=[*LARGE, *WRONG])
def test_a_specification_that_nobody_trains_is_refused_before_anything_is_allocated(
    tmp_path, saved, monkeypatch, change
):
    layout = {**select().as_json()["layout"], **change.get("layout", {})}
    path = edited(saved, tmp_path, _spec(**{**change, "layout": layout}))
    monkeypatch.setattr(networks, "_orthogonal", MagicMock(side_effect=MemoryError("weights of that size")))
    for load in (Learner.load, Actor.load):
        refused_by(load, path, "its policy cannot be used")


@pytest.mark.parametrize(
    "change",
    [
        _cut("adam.3.exp_avg_sq"),
        _cut("usual"),
        _cut("value.mid"),
        _filled("adam.0.step", np.nan),
        _filled("adam.0.exp_avg_sq", -1.0),
        _fact("rewards", {"count": 5, "mean": 0.0, "variance": -1.0}),
        _fact("rewards", {"count": -5, "mean": 0.0, "variance": 1.0}),
        _fact("seed", "zz"),
        _fact("updates", float("inf")),
        _fact("streams", {}),
    ],
)
def test_what_a_learner_cannot_have_saved_is_refused(tmp_path, saved, change):
    refused_by(Learner.load, edited(saved, tmp_path, change))


def test_an_archive_that_grows_when_it_is_unpacked_is_not_unpacked(tmp_path):
    path = tmp_path / "policy.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed, packed.open("actor.in.npy", "w") as file:
        for _ in range(MAX_BYTES // 2**20 + 1):
            file.write(bytes(2**20))
    assert path.stat().st_size < 2**20
    with pytest.raises(checkpoint.CheckpointError, match="unpacked it has"):
        Actor.load(path)


@pytest.mark.parametrize("spec", [select(), WAIT], ids=lambda s: s.action)
def test_the_entropy_bonus_raises_the_entropy(spec):
    """Of equal rewards only the entropy's gradient is left in the policy: its sign decides where it moves."""
    learner = Learner(replace(spec, entropy=0.1), 0)
    with torch.no_grad():
        learner._actor["out_b"] += torch.tensor([2.0] + [0.0] * (len(learner._actor["out_b"]) - 1))
    found = []
    for _ in range(5):
        batch = replace(collect(learner, FreshOnes(), range(64)), rewards=np.ones(64))
        found.append(learner.update(batch).entropy)
    assert found[-1] > found[0] + 0.05


def test_a_pass_ends_when_the_policy_has_moved_far_enough():
    problem = FreshOnes()
    free, held = Learner(select(target_kl=1e9), 0), Learner(select(target_kl=1e-4), 0)
    batch = collect(free, problem, range(64))
    assert free.update(batch).steps == 10
    assert held.update(batch).steps < 10


def test_running_statistics_of_rewards_are_those_of_all_of_them():
    """Batches of different means: a shift between them is part of the variance."""
    batches = [np.array([1.0, 2.0, 3.0]), np.array([11.0, 15.0]), np.array([-40.0, -38.0, -36.0, -30.0])]
    running = _RunningMeanStd()
    for n, values in enumerate(batches):
        running.add(values)
        whole = np.concatenate(batches[: n + 1])
        assert (running.count, running.mean) == (len(whole), pytest.approx(whole.mean(), rel=1e-12))
        assert running.variance == pytest.approx(whole.var(), rel=1e-12)
    standardized = running.standardized(np.concatenate(batches))
    assert standardized.std() == pytest.approx(1.0) and standardized.mean() == pytest.approx(0.0, abs=1e-12)
    running.add(np.zeros(5000))
    assert running.count == 4096, "what is older fades"


def test_outliers_are_judged_by_earlier_values_and_at_first_by_the_others():
    first, running = np.array([1000.0, 1001.0, 1002.0, 1003.0, 9000.0]), _RunningMeanStd()
    assert running.clipped(first).tolist() == [1000.0, 1001.0, 1002.0, 1003.0, 1022.0], "ten times the quartiles' gap"
    running.add(np.array([-1.0, 1.0]))
    assert running.clipped(first).tolist() == [10.0] * 5, "ten standard deviations"


def test_a_minibatch_is_clipped_where_its_ratio_leaves_the_range():
    """Two actions, twice as probable as when they were taken: the gain is clipped at 1 + clip, the loss is not."""
    now = torch.log(torch.tensor([0.8, 0.8], dtype=torch.float64)).requires_grad_()
    zeros, values = torch.zeros(2, dtype=torch.float64), torch.tensor([1.0, 1.0], dtype=torch.float64)
    acted = Acted(
        torch.log(torch.tensor([0.4, 0.4], dtype=torch.float64)),
        torch.tensor([1.0, -1.0], dtype=torch.float64),
        torch.tensor([3.0, -1.0], dtype=torch.float64),
    )
    spec = select(passes=1, clip=0.2, value=0.5, entropy=0.0)
    adam = torch.optim.Adam([now], lr=1e-9)
    rng = np.random.default_rng(0)
    found = clipped_update(spec, lambda some: (now[some], zeros[some], values[some]), acted, [now], adam, rng)
    assert found.policy_loss == pytest.approx(-(1.2 - 2.0) / 2) and found.value_loss == pytest.approx((4 + 4) / 2)
    assert found.moved == pytest.approx(2.0 - 1.0 - np.log(2.0)) and found.clipped == 1.0
    assert (found.steps, found.skipped) == (1, 0)
