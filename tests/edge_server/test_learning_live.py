"""A learnt policy in a running edge server: it decides, goes on learning, says so, leaves what it learnt."""

from __future__ import annotations

import json
import threading
from dataclasses import replace

import numpy as np
import pytest

from edge_server.config import PolicyConfig, read_config
from edge_server.scheduler.learned.apprentice import Leash
from edge_server.scheduler.learned.decide import Actor
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.spec import Spec
from edge_server.scheduler.learned.state import StateLayout
from edge_server.server import EdgeServer, Options
from freshfield.scenario import ScenarioError
from tests.edge_server.test_server import Feed, tiny_scenario, until
from tests.ports import free_port


@pytest.fixture
def policy(tmp_path):
    path = tmp_path / "policy.npz"
    Learner(Spec("select", StateLayout(("age", "pose")), hidden=8), seed=1).save(path)
    return path


def server(tmp_path, policy, held_out=("cam00",), port=None, **more) -> EdgeServer:
    what = tiny_scenario(tmp_path, held_out)
    config = replace(read_config(what), policy=PolicyConfig(str(policy)))
    options = Options(f"127.0.0.1:{port or free_port()}", tmp_path / "out", **more)
    return EdgeServer(what, config, options)


def test_it_decides_learns_and_leaves_what_it_learnt(tmp_path, policy, monkeypatch):
    monkeypatch.setattr("edge_server.scheduler.learned.apprentice.Leash", lambda: Leash(batch=3, settle=2))
    port = free_port()
    edge = server(tmp_path, f"bandit:{policy}", port=port, learn="set", fallback="threshold:200")
    assert edge.state.policies[0] == f"bandit:{policy}" == edge.state.controls.policy
    thread = threading.Thread(target=edge.run, daemon=True)
    thread.start()
    feed = Feed(port, edge.scenario.cameras, ("cam00",))
    feed.start()
    try:
        until(lambda: edge.status()["learning"]["updates"] >= 2)
        assert "learning: the learnt policy decides" in edge.state.learning()
        edge.state.set_policy("all", None)
        assert edge.state.learning() == ""
        edge.state.set_policy(f"bandit:{policy}", None)
        assert edge.updates is not None and "learning" in edge.state.learning()
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
def test_who_cannot_learn_is_refused_in_one_line(held_out, name, said, tmp_path, policy):
    if name == "threshold:90":
        what = tiny_scenario(tmp_path, held_out)
        config = replace(read_config(what), policy=PolicyConfig("threshold", 90.0))
        make = lambda: EdgeServer(what, config, Options("127.0.0.1:1", tmp_path / "out", learn=""))  # noqa: E731
    else:
        make = lambda: server(tmp_path, name or f"bandit:{policy}", held_out, learn="")  # noqa: E731
    with pytest.raises(ScenarioError, match=said) as error:
        make()
    assert str(error.value).count("\n") == 0


def test_without_being_asked_nothing_learns(tmp_path, policy):
    edge = server(tmp_path, f"bandit:{policy}")
    assert edge.lessons is None and edge.status()["learning"] is None and edge.state.learning() == ""
    assert edge.updates.embeddings is None
