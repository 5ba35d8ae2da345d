"""A learned policy in a running edge server: it decides, goes on learning, and leaves what it learned."""

from __future__ import annotations

import json
import threading
from dataclasses import asdict, replace

import numpy as np
import pytest

from edge_server.cli import main
from edge_server.config import LearnConfig, PolicyConfig, read_config
from edge_server.live.server import EdgeServer, ServerOptions
from edge_server.scheduler import parse_policy
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.rewards import make_reward
from edge_server.scheduler.learned.state import StateLayout
from edge_server.scheduler.online.online_policy import OnlineSettings
from edge_server.scheduler.registry import policy_label
from freshfield.scenario import ScenarioError
from tests.edge_server.fields_for_tests import TINY
from tests.edge_server.live.test_server import Feed, tiny_scenario, until
from tests.ports import free_port


@pytest.fixture
def policy(tmp_path):
    path = tmp_path / "policy.npz"
    Learner(Spec("select", StateLayout(("age", "pose")), hidden=8), seed=1).save(path)
    return path


def server(tmp_path, policy, held_out=("cam00",), port=None, learn=None) -> EdgeServer:
    what = tiny_scenario(tmp_path, held_out)
    config = replace(read_config(what), policy=PolicyConfig(*parse_policy(policy)), learn=learn)
    options = ServerOptions(f"127.0.0.1:{port or free_port()}", tmp_path / "out")
    return EdgeServer(what, config, options)


def test_it_decides_learns_and_leaves_what_it_learned(tmp_path, policy, monkeypatch):
    settings = OnlineSettings(batch=3, warmup=2)
    monkeypatch.setattr("edge_server.scheduler.online.online_policy.OnlineSettings", lambda: settings)
    port = free_port()
    edge = server(tmp_path, f"bandit:{policy}", port=port, learn=LearnConfig("set", "threshold:200"))
    assert edge.state.policies[0] == f"bandit:{policy}" == edge.state.controls.policy
    assert edge.status()["policy"] == "bandit:policy.npz"
    thread = threading.Thread(target=edge.run, daemon=True)
    thread.start()
    feed = Feed(port, edge.scenario.cameras, ("cam00",))
    feed.start()
    try:
        until(lambda: edge.status()["learning"]["updates"] >= 2)
        assert "learning: the learned policy decides" in edge.state.learning()
        edge.state.set_policy("all", None)
        assert edge.state.learning() == ""
        edge.state.set_policy(f"bandit:{policy}", None)
        assert edge.updater is not None and "learning" in edge.state.learning()
    finally:
        feed.stop()
        edge.stop()
        thread.join(30)
    lines = [json.loads(line) for line in (tmp_path / "out/learning.jsonl").read_text().splitlines()]
    assert [line["update"] for line in lines[:2]] == [1, 2] and np.isfinite(lines[0]["reward"])
    status = json.loads((tmp_path / "out/edge.json").read_text())["learning"]
    assert status["updates"] >= 2 and status["fixed"] == "threshold:200"
    before, after = (Actor.load(p).weights for p in (policy, tmp_path / "out/learnt.npz"))
    assert any(not np.array_equal(w, after[name]) for name, w in before.items())


@pytest.mark.parametrize(
    ("held_out", "name", "said"),
    [
        ((), None, "held out"),
        (("cam00",), "threshold:90", "cannot learn"),
        (("cam00",), "bandit:nowhere.npz", "no such checkpoint"),
    ],
)
def test_a_policy_that_cannot_learn_is_refused_in_one_line(held_out, name, said, tmp_path, policy):
    with pytest.raises(ScenarioError, match=said) as error:
        server(tmp_path, name or f"bandit:{policy}", held_out, learn=LearnConfig())
    assert str(error.value).count("\n") == 0


def test_a_policy_learns_on_by_the_reward_it_was_trained_by_or_says_what_is_missing(tmp_path, policy):
    learner = Learner.load(policy)
    learner.reward_fields = asdict(make_reward("set", "moving", distance=-0.25))
    learner.save(policy)
    by = server(tmp_path, f"bandit:{policy}", learn=LearnConfig()).trainer.reward
    assert (by.name, by.fidelity) == ("set", "moving") and by.distance in (-0.25, 0.0)
    learner.reward_fields = asdict(make_reward("set", distance_is="perceptual"))
    learner.save(policy)
    with pytest.raises(ScenarioError, match=r"edge.metrics: \[perceptual\]"):
        server(tmp_path, f"bandit:{policy}", learn=LearnConfig())


def test_without_being_asked_nothing_learns(tmp_path, policy):
    edge = server(tmp_path, f"bandit:{policy}")
    assert edge.trainer is None and edge.status()["learning"] is None and edge.state.learning() == ""
    assert edge.updater.embeddings is None


def refused(capsys, *words: str) -> str:
    """The message of options that the command refuses: one line, once."""
    assert main(["run", *map(str, words)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def on_disk(tmp_path, **edge) -> str:
    path = tmp_path / "tiny.yaml"
    section = {"field_options": TINY, "lpips": "none", **edge}
    cameras = {"count": 3, "held_out": ["cam00"]}
    path.write_text(json.dumps({"name": "tiny", "seed": 3, "cameras": cameras, "edge": section}))
    return str(path)


def test_a_fallback_beside_nothing_that_learns_is_refused(tmp_path, policy, capsys):
    out, file = ("--out", str(tmp_path / "out")), on_disk(tmp_path)
    words = ("--policy", f"bandit:{policy}", "--fallback", "all", *out)
    assert "--fallback: nothing learns beside it" in refused(capsys, file, *words)
    learning = on_disk(tmp_path, policy={"name": f"bandit:{policy}"}, learn={})
    said = refused(capsys, learning, "--policy", "threshold:90", "--fallback", "all", *out)
    assert "--fallback: nothing learns beside it" in said


def test_a_file_that_only_decides_is_named_once_and_not_called_damaged(tmp_path, policy, capsys):
    decides = tmp_path / "decides.npz"
    Actor.load(policy).save(decides)
    file = on_disk(tmp_path)
    said = refused(capsys, file, "--policy", f"bandit:{decides}", "--learn", "--out", str(tmp_path / "out"))
    assert "learning cannot resume from it" in said and "damaged" not in said
    assert said.count(file) == 1 and said.count(str(decides)) == 1


@pytest.mark.parametrize(
    ("words", "reward", "fallback"),
    [
        ([], "set:moving", "threshold:200"),
        (["--learn"], "set:moving", "threshold:200"),
        (["--learn", "thesis", "--fallback", "all"], "thesis", "all"),
        (["--policy", "threshold:90"], None, None),
    ],
)
def test_a_scenario_says_that_its_policy_learns_and_the_command_has_the_last_word(
    tmp_path, policy, monkeypatch, words, reward, fallback
):
    learn = {"reward": "set:moving", "fallback": "threshold:200"}
    file = on_disk(tmp_path, policy={"name": f"bandit:{policy.name}"}, learn=learn)
    found = []
    monkeypatch.setattr(EdgeServer, "run", lambda self: found.append(self))
    monkeypatch.setattr("edge_server.cli.signal.signal", lambda *_: None)  # Ctrl-C is pytest's
    assert main(["run", file, "--out", str(tmp_path / "out"), *words]) == 0
    trainer = found[0].trainer
    if reward is None:
        assert trainer is None
        return
    name, _, on = reward.partition(":")
    assert (trainer.reward.name, trainer.reward.fidelity) == (name, on or "whole")
    assert policy_label(trainer.policy.fixed) == fallback


def test_a_scenario_with_a_mistyped_key_of_learning_is_refused(tmp_path, policy, capsys):
    file = on_disk(tmp_path, learn={"rewards": "set"})
    assert "edge.learn" in refused(capsys, file, "--out", str(tmp_path / "out"))
