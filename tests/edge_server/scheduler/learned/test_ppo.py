"""Learning happens, on bandits whose optimum is known, and repeats; checkpoints lose nothing; all stays finite."""

import re
import zipfile
from dataclasses import fields, replace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from edge_server.fields import checkpoint
from edge_server.scheduler.learned import distributions as d
from edge_server.scheduler.learned import learning_constants, networks, ppo
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.clipped_update import Acted, UpdateFigures, clipped_update
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.ppo import Diagnostics, Learner, _RunningMeanStd
from edge_server.scheduler.learned.state import State, StateLayout
from tests.edge_server.scheduler.learned import problems
from tests.edge_server.scheduler.learned.problems import FreshOnes, Waits, act, batch_of, collect, state, teach, value
from tests.support import refused


def select(**more) -> Spec:
    return Spec("select", FreshOnes.layout, **more)


WAIT = Spec("wait", Waits.layout, problems.OMEGAS_MS)


@pytest.mark.parametrize(("problem", "spec"), [(FreshOnes(), select()), (Waits(), WAIT)], ids=["sets", "omegas"])
def test_512_decisions_are_enough_to_learn_from(problem, spec):
    """A random set loses .35, an untrained network .01 to .6 of a gain of .5; noise of a reward is .1. A random omega
    loses .104, the best fixed one .05."""
    learner = Learner(spec, 0)
    teach(learner, problem, 8)
    assert problems.regret(learner, problem) < 0.02


def test_a_batch_of_one_decision_learns_against_the_value():
    """Algorithms 1 and 2 update after every slot: centered by its batch, an advantage would be zero."""
    learner = Learner(WAIT, 0)
    teach(learner, Waits(), 1)
    for better in (1.0, -1.0):
        states = [Waits().draw(77).state]
        actions, before = act(learner, states)
        worth = value(learner, states) + better
        learner.update(batch_of(learner, states, actions, before, worth))
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
    assert problems.same(through, resumed)
    assert (resumed.updates, resumed.decisions) == (4, 256)
    s = [state(6, np.random.default_rng(0))]
    assert value(through, s) == value(resumed, s)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """The file of a learner that has been taught once."""
    learner = Learner(select(), 0)
    teach(learner, FreshOnes(), 1)
    learner.save(path := tmp_path_factory.mktemp("saved") / "policy.npz")
    return path


def of_spec(**changed):
    return lambda arrays, about: about["spec"].update(changed)


def of_array(name, change):
    return lambda arrays, about: arrays.update({name: change(arrays[name])})


def cut(array):
    return array.T[..., :1]


DAMAGED = {
    "cut off": None,
    "nan": lambda arrays, about: arrays["actor.in"].__setitem__((0, 0), np.nan),
    "shape": of_array("actor.in", cut),
    "words": of_array("actor.in", lambda array: array.astype(str)),
    "lacks": lambda arrays, about: arrays.pop("actor.out"),
}
SPECIFIED = {
    "action": of_spec(action="guess"),
    "hidden is text": of_spec(hidden="64"),
    "omegas do not rise": of_spec(action="wait", omegas_ms=[50.0, 50.0]),
    "waits too long": of_spec(action="wait", omegas_ms=[0.0, 1e308]),
    "learning rate is no number": of_spec(learning_rate=float("nan")),
    "hidden is large": of_spec(hidden=30_000),
    "first layer is large": of_spec(hidden=1024, layout=StateLayout(("age", "semantics"), dim=4096).__dict__),
}
OF_LEARNERS = {
    "moments": of_array("adam.3.exp_avg_sq", cut),
    "value": of_array("value.mid", cut),
    "step": of_array("adam.0.step", lambda array: np.full_like(array, np.nan)),
    "negative moments": of_array("adam.0.exp_avg_sq", lambda array: np.full_like(array, -1.0)),
    "rewards": lambda arrays, about: about["rewards"].update(variance=-1.0),
    "updates": lambda arrays, about: about.update(updates=float("inf")),
    "streams": lambda arrays, about: about.update(streams={}),
}


@pytest.mark.parametrize("damage", [*DAMAGED, *SPECIFIED, *OF_LEARNERS])
def test_what_no_learner_has_saved_is_refused_in_one_line_before_anything_is_allocated(
    tmp_path, saved, monkeypatch, damage
):
    path, said = tmp_path / "policy.npz", ".* its policy cannot be used" if damage in SPECIFIED else ""
    if change := {**DAMAGED, **SPECIFIED, **OF_LEARNERS}[damage]:
        arrays, about = checkpoint.load(saved, kind="scheduler")
        change(arrays, about)
        checkpoint.save(path, arrays, about, kind="scheduler")
    else:
        path.write_bytes(saved.read_bytes()[:-200])
    if damage in SPECIFIED:
        monkeypatch.setattr(networks, "_orthogonal", MagicMock(side_effect=MemoryError("weights of that size")))
    for load in [Learner.load] if damage in OF_LEARNERS else [Learner.load, Actor.load]:
        found = refused(checkpoint.CheckpointError, f"^{re.escape(str(path))}{said}", load, path)
        assert str(found).count(str(path)) == 1


def test_an_archive_that_grows_when_it_is_unpacked_is_not_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr(learning_constants, "MAX_LEARNER_BYTES", 2**22)
    path = tmp_path / "policy.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("actor.in.npy", bytes(2**22 + 1))
    assert path.stat().st_size < 2**20
    refused(checkpoint.CheckpointError, "unpacked it has", Actor.load, path)


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


def test_advantages_are_what_rewards_exceed_the_value_by_in_units_of_their_spread(monkeypatch):
    learner, seen = Learner(select(), 0), []
    teach(learner, FreshOnes(), 3)
    taken = collect(learner, FreshOnes(), range(500, 564))
    figures = UpdateFigures(**dict.fromkeys([field.name for field in fields(UpdateFigures)], 0.0))
    monkeypatch.setattr(ppo, "clipped_update", lambda _, *given: seen.append(given[:2]) or figures)
    learner.update(taken)
    ((evaluate, acted),) = seen
    above = (acted.returns - evaluate(torch.arange(64))[2]).detach().numpy()
    np.testing.assert_allclose(acted.advantages, (above - above.mean()) / above.std(), rtol=1e-6)
    assert 0.5 < acted.returns.std() < 2.0


def test_a_minibatch_is_clipped_where_its_ratio_leaves_the_range():
    """Two actions, twice as probable as when they were taken: the gain is clipped at 1 + clip, the loss is not."""
    zeros, values = torch.zeros(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
    now, before = (values * np.log(probability) for probability in (0.8, 0.4))
    acted = Acted(before, torch.tensor([1.0, -1.0]).double(), torch.tensor([3.0, -1.0]).double())
    now.requires_grad_()
    spec = select(passes=1, clip=0.2, value=0.5, entropy=0.0)
    adam = torch.optim.Adam([now], lr=1e-9)
    rng = np.random.default_rng(0)
    found = clipped_update(spec, lambda some: (now[some], zeros[some], values[some]), acted, [now], adam, rng)
    assert found.policy_loss == pytest.approx(-(1.2 - 2.0) / 2) and found.value_loss == pytest.approx((4 + 4) / 2)
    assert found.moved == pytest.approx(2.0 - 1.0 - np.log(2.0)) and found.clipped == 1.0
    assert (found.steps, found.skipped) == (1, 0)


HARD = StateLayout(("age", "pose", "semantics"), dim=4)


@pytest.fixture(params=["select", "wait"])
def spec(request) -> Spec:
    return Spec(request.param, HARD, problems.OMEGAS_MS if request.param == "wait" else ())


EXTREME_AGES_MS = [0.0, -0.0, 1e12, -1e12, np.inf, -np.inf, np.nan, 5e-324, 1.7e308, 80.0]
EXTREMES = np.array([np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e-45, 0.0, -0.0, 1.0, 1e20])


def finite(learner: Learner, diagnostics: Diagnostics | None = None) -> None:
    assert all(np.isfinite(w).all() for w in learner.actor.weights.values())
    if diagnostics is not None:
        d = diagnostics
        assert np.isfinite((d.policy_loss, d.value_loss, d.entropy, d.moved, d.clipped, d.gradient)).all()
        assert d.skipped == 0


def decide_and_learn(learner: Learner, states: list[State], rewards=None) -> Diagnostics:
    actions, logps = act(learner, states)
    assert np.isfinite(logps).all() and (logps <= 1e-9).all()
    given = np.random.default_rng(0).standard_normal(len(states)) if rewards is None else rewards
    diagnostics = learner.update(batch_of(learner, states, actions, logps, given))
    finite(learner, diagnostics)
    assert np.isfinite(value(learner, states)).all()
    return diagnostics


@pytest.mark.stability
def test_extreme_ages(spec):
    n = len(EXTREME_AGES_MS)
    states = []
    for shift in range(n):
        s = state(n, np.random.default_rng(shift), d=4)
        states.append(replace(s, ages_ms=np.roll(EXTREME_AGES_MS, shift), reported=np.ones(n, bool)))
    assert np.isfinite(HARD.batch(states)).all()
    for _ in range(3):
        decide_and_learn(Learner(spec, 0), states)
    order = np.argsort(StateLayout(("age",)).features(states[0])[[0, 9, 2], 0])
    np.testing.assert_array_equal(order, [0, 1, 2])  # 0, 80 and 1e12 ms stay in order


@pytest.mark.parametrize("part", ["poses", "embeddings"])
@pytest.mark.stability
def test_extreme_poses_and_embeddings(spec, part):
    rng = np.random.default_rng(1)
    states = []
    for _ in range(16):
        s = state(6, rng, d=4)
        array = rng.choice(EXTREMES, getattr(s, part).shape).astype(getattr(s, part).dtype)
        states.append(replace(s, **{part: array}))
    assert np.abs(HARD.batch(states)).max() <= max(8.0, np.log1p(HARD.oldest_ms / HARD.age_scale_ms))
    decide_and_learn(Learner(spec, 0), states)
    seen = np.concatenate([s.embeddings for s in states if s.embeddings is not None]).astype(np.float64)
    fitted = HARD.standardized(seen)
    assert np.isfinite(fitted.batch(states)).all()
    decide_and_learn(Learner(replace(spec, layout=fitted), 0), states)


@pytest.mark.stability
@pytest.mark.parametrize("reward", [0.873, 1e90])
def test_constant_reward_moves_the_policy_nowhere(spec, reward):
    learner = Learner(replace(spec, entropy=0.0), 0)
    before = learner.actor.weights
    states = [state(6, np.random.default_rng(i), d=4) for i in range(32)]
    for _ in range(10):
        diagnostics = decide_and_learn(learner, states, np.full(32, reward))
        assert diagnostics.reward == pytest.approx(reward)
    assert all(np.array_equal(w, learner.actor.weights[name]) for name, w in before.items())


@pytest.mark.stability
def test_rewards_that_are_no_numbers_are_left_out_and_counted():
    learner, problem = Learner(Spec("select", FreshOnes.layout), 0), FreshOnes()
    for number in range(10):
        batch = collect(learner, problem, range(64 * number, 64 * number + 64))
        batch.rewards[::3] = [np.nan, np.inf, -np.inf, 1e200] * 5 + [np.nan, -1e300]
        diagnostics = learner.update(batch)
        finite(learner, diagnostics)
        assert diagnostics.dropped == 22
    assert problems.regret(learner, problem) < 0.03
    nothing = collect(learner, problem, range(8))
    nothing.rewards[:] = np.nan
    diagnostics = learner.update(nothing)
    assert diagnostics.steps == 0 and diagnostics.dropped == 8 and diagnostics.reward is None


@pytest.mark.stability
@pytest.mark.parametrize("claimed", [-1e300, -800.0, -50.0, 0.0])
def test_ratios_that_overflow(spec, claimed):
    """Log-probabilities that another policy, or a damaged record, claims."""
    learner = Learner(spec, 0)
    states = [state(6, np.random.default_rng(i), d=4) for i in range(32)]
    actions, _ = act(learner, states)
    rewards = np.random.default_rng(1).standard_normal(32)
    for _ in range(5):
        finite(learner, learner.update(batch_of(learner, states, actions, np.full(32, claimed), rewards)))
    diagnostics = learner.update(batch_of(learner, states, actions, np.full(32, np.nan), rewards))
    assert diagnostics.dropped == 32
