"""A whole edge server with a learned policy: real frames, a real embedder, recorded decisions."""

from __future__ import annotations

import threading

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="the extra embed is not installed")
pytest.importorskip("onnx", reason="the extra embed is not installed")

from edge_server.live.server import EdgeServer, ServerOptions
from edge_server.report.explain_command import main as explain
from edge_server.scheduler.learned.decision_record import read_decision
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.settings import Spec
from edge_server.scheduler.learned.state import StateLayout
from edge_server.settings import read_config
from freshfield import scenario
from tests.edge_server.embed.graphs import CHANNELS, detector
from tests.edge_server.fields_for_tests import TINY
from tests.edge_server.live.test_server import Feed, until
from tests.support import free_port


def server_of(tmp_path, layout, embedding=True, port=None):
    Learner(Spec("select", layout), 1).save(tmp_path / "policy.npz")
    detector(tmp_path / "d.onnx")
    edge = {"field": "ngp", "field_options": TINY, "update_ms": 50, "grace_ms": 500, "lpips": "none"}
    edge["policy"] = {"name": "bandit:policy.npz"}
    if embedding:
        edge["embedding"] = {"model": "d.onnx", "dim": CHANNELS}
    data = {"name": "tiny", "seed": 3, "cameras": {"count": 3, "held_out": ["cam00"]}, "edge": edge}
    made = scenario.parse(data, tmp_path / "tiny.yaml")
    return EdgeServer(made, read_config(made), ServerOptions(f"127.0.0.1:{port or free_port()}", tmp_path / "out"))


def test_it_decides_by_what_cameras_see_and_every_decision_can_be_explained(tmp_path, capsys):
    port = free_port()
    server = server_of(tmp_path, StateLayout(("age", "pose", "semantics"), dim=CHANNELS), port=port)
    thread = threading.Thread(target=server.run)
    thread.start()
    feed = Feed(port, server.scenario)
    feed.start()
    try:
        until(lambda: server.updater.number >= 4)
        decided = server.updater.policy.last_decision
        assert decided is not None and decided.actor.spec.layout.dim == CHANNELS
        with pytest.raises(ValueError, match="chosen at the start"):
            server.state.set_policy(f"bandit:{tmp_path / 'other.npz'}", None)
        server.state.set_policy("threshold", 100.0)
        server.state.set_policy(f"bandit:{tmp_path / 'policy.npz'}", None)
    finally:
        server.stop()
        thread.join(20)
        feed.stop()
    found = read_decision(tmp_path / "out", 1)
    used = [c for c, chosen in zip(found.decision.state.cameras, found.decision.action) if chosen]
    published = next(p for p in server.state.publications() if p.number == 1)
    assert list(published.selected) == used
    assert np.isfinite(found.decision.state.embeddings).any()
    assert explain([str(tmp_path / "out"), "--decision", "1"]) == 0
    assert "in the picture of" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("dim", "embedding", "said"), [(CHANNELS, False, r"tiny\.yaml: edge"), (2, True, "of 2 numbers")]
)
def test_with_another_embedding_or_another_width_it_does_not_start(tmp_path, dim, embedding, said):
    """The scenario that names none has the usual embedding, which is another."""
    with pytest.raises(scenario.ScenarioError, match=said):
        server_of(tmp_path, StateLayout(("semantics",), dim=dim), embedding)
