"""Learning happens, on bandits whose optimum is known; the same seed gives the same weights; nothing is lost
in a checkpoint."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.fields import checkpoint
from edge_server.scheduler.learned.decide import Actor
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.problem import collect
from edge_server.scheduler.learned.spec import Spec
from tests.edge_server.scheduler.learned.problems import OMEGAS_MS, FreshOnes, Waits, regret, state, teach


def same(a: Learner, b: Learner) -> bool:
    mine, other = a.actor.weights, b.actor.weights
    return all(np.array_equal(mine[name], other[name]) for name in mine)


def select(**more) -> Spec:
    return Spec("select", FreshOnes.layout, **more)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_sets_are_learnt_in_512_decisions(seed):
    """A random set loses .35, an untrained network .01 to .6 of a gain of .5; noise of a reward is .1."""
    learner = Learner(select(), seed)
    teach(learner, FreshOnes(), 8)
    assert regret(learner, FreshOnes()) < 0.02


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_omegas_are_learnt_in_512_decisions(seed):
    """A random omega loses .104 here, the best fixed one .05."""
    learner = Learner(Spec("wait", Waits().layout, OMEGAS_MS), seed)
    teach(learner, Waits(), 8)
    assert regret(learner, Waits()) < 0.02


def test_no_fixed_omega_is_as_good_as_what_was_learnt():
    drawn = [Waits().draw(10**6 + i) for i in range(300)]
    fixed = min(np.mean([d.regret(k) for d in drawn]) for k in range(len(OMEGAS_MS)))
    assert fixed > 0.04


def test_what_cameras_see_is_learnt_from_embeddings():
    problem = Waits(semantic=True)
    learner = Learner(Spec("threshold", problem.layout, OMEGAS_MS), 0)
    teach(learner, problem, 8)
    assert regret(learner, problem) < 0.02


def test_a_flat_network_learns_as_the_thesis_has_it():
    learner = Learner(select(network="flat", cameras=6), 0)
    teach(learner, FreshOnes(), 16)
    assert regret(learner, FreshOnes()) < 0.05


def test_what_was_learnt_with_six_cameras_holds_for_eleven_and_with_silent_ones():
    learner = Learner(select(), 0)
    teach(learner, FreshOnes(), 8)
    assert regret(learner, FreshOnes(cameras=11)) < 0.03
    assert regret(learner, FreshOnes(cameras=11, silent=4)) < 0.03


def test_the_value_learns_what_a_state_is_worth():
    learner, problem = Learner(select(), 0), FreshOnes()
    teach(learner, problem, 12)
    drawn = [problem.draw(10**6 + i) for i in range(200)]
    worth = np.array([d.gain(d.best) for d in drawn])
    assert np.corrcoef(learner.value([d.state for d in drawn]), worth)[0, 1] > 0.8


def test_the_same_seed_gives_the_same_weights_bit_for_bit_and_another_does_not():
    learners = [Learner(select(), seed) for seed in (5, 5, 6)]
    for learner in learners:
        teach(learner, FreshOnes(), 3)
    assert same(learners[0], learners[1])
    assert not same(learners[0], learners[2])


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
    assert same(through, Learner.load(save(through, tmp_path / "again.npz")))


def save(learner, path):
    learner.save(path)
    return path


def test_a_new_learner_has_a_checkpoint_too(tmp_path):
    fresh = Learner(select(), 1)
    assert same(fresh, Learner.load(save(fresh, tmp_path / "new.npz")))


def test_the_actor_of_a_checkpoint_decides_as_its_learner(tmp_path):
    learner = Learner(select(), 2)
    teach(learner, FreshOnes(), 2)
    actor = Actor.load(save(learner, tmp_path / "policy.npz"))
    s = state(9, np.random.default_rng(3), silent=2)
    np.testing.assert_array_equal(actor.act([s])[0][0], learner.greedy(s))


def test_deciding_needs_no_torch(tmp_path):
    import subprocess
    import sys

    path = save(Learner(select(), 0), tmp_path / "policy.npz")
    code = (
        "import sys, numpy as np; from edge_server.scheduler import make_policy;"
        f"make_policy('bandit:{path}', None, np.random.default_rng(0));"
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def damaged(path, what):
    """A checkpoint that is wrong in one way."""
    if what == "cut":
        path.write_bytes(path.read_bytes()[:-200])
    elif what == "text":
        path.write_text("weights: all of them")
    elif what == "empty":
        path.write_bytes(b"")
    elif what == "array":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    elif what == "field":
        checkpoint.save(path, {"a": np.zeros(3)})
    elif what == "pickle":
        with path.open("wb") as file:
            np.savez(file, __facts__=np.array([print], dtype=object))
    else:
        arrays, about = checkpoint.load(path, kind="scheduler")
        if what == "nan":
            arrays["actor.in"][0, 0] = np.nan
        elif what == "shape":
            arrays["actor.in"] = arrays["actor.in"][:, 1:]
        elif what == "lacks":
            del arrays["actor.out"]
        elif what == "spec":
            about["spec"]["action"] = "guess"
        elif what == "key":
            about["spec"]["depth"] = 3
        checkpoint.save(path, arrays, about, kind="scheduler")
    return path


@pytest.mark.parametrize(
    "what",
    ["cut", "text", "empty", "array", "field", "pickle", "nan", "shape", "lacks", "spec", "key"],
)
def test_a_file_that_is_no_whole_checkpoint_is_refused_in_one_line(tmp_path, what):
    path = damaged(save(Learner(select(), 0), tmp_path / "policy.npz"), what)
    for load in (Learner.load, Actor.load):
        with pytest.raises(checkpoint.CheckpointError) as refused:
            load(path)
        assert str(refused.value).startswith(str(path))
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["adam.0.exp_avg", "adam.3.exp_avg_sq", "usual", "value.mid"])
def test_a_checkpoint_that_could_not_be_learnt_from_is_refused(tmp_path, name):
    learner = Learner(select(), 0)
    teach(learner, FreshOnes(), 1)
    path = save(learner, tmp_path / "policy.npz")
    arrays, about = checkpoint.load(path, kind="scheduler")
    arrays[name] = arrays[name].T[..., :1]
    checkpoint.save(path, arrays, about, kind="scheduler")
    with pytest.raises(checkpoint.CheckpointError, match="damaged"):
        Learner.load(path)


def test_what_is_not_there_is_refused(tmp_path):
    with pytest.raises(checkpoint.CheckpointError, match="no such"):
        Learner.load(tmp_path / "nothing.npz")


def test_diagnostics_say_what_an_update_did():
    learner, problem = Learner(select(), 0), FreshOnes()
    told = learner.update(collect(learner, problem, range(64)))
    assert told.reward is not None and told.dropped == told.skipped == 0
    assert told.steps >= 1 and told.gradient > 0
    assert 0.0 <= told.clipped <= 1.0 and told.moved >= 0.0
    assert told.entropy == pytest.approx(6 * np.log(2), rel=0.1)


def test_a_pass_ends_when_the_policy_has_moved_far_enough():
    problem = FreshOnes()
    free, held = Learner(select(target_kl=1e9), 0), Learner(select(target_kl=1e-4), 0)
    batch = collect(free, problem, range(64))
    assert free.update(batch).steps == 10
    assert held.update(batch).steps < 10


def test_deciding_with_exploring_uses_the_learners_own_stream():
    a, b = Learner(select(), 4), Learner(select(), 4)
    states = [state(6, np.random.default_rng(i)) for i in range(20)]
    b.act(states, explore=False)
    for x, y in zip(a.act(states), b.act(states)):
        np.testing.assert_array_equal(x, y)
    assert not np.array_equal(a.act(states)[0], b.act(states, explore=False)[0])
