"""The command: text, figures and picture of a recorded decision, with a real embedder."""

from __future__ import annotations

import re
from importlib.util import find_spec

import cv2
import numpy as np
import pytest

from edge_server.report.explain_command import main
from edge_server.scheduler.learned.actor import Decision
from edge_server.scheduler.learned.decision_record import DecisionWriter
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.settings import Spec
from edge_server.scheduler.learned.state import StateLayout
from tests.edge_server.scheduler.learned.problems import OMEGAS_MS, state
from tests.edge_server.scheduler.learned.test_bandit import a_decision

HAS_ONNX = find_spec("onnx") and find_spec("onnxruntime")
NEEDS_ONNX = pytest.mark.skipif(not HAS_ONNX, reason="the extra embed is not installed")
NOWHERE = {"model": "/nowhere/d.onnx", "dim": 3}


def ages_only(run):
    actor = Learner(Spec("wait", StateLayout(("age",)), OMEGAS_MS), 0).actor
    s = state(3, np.random.default_rng(0))
    (action,), (logp,) = actor.act([s])
    DecisionWriter(run).write(Decision(4, 0, s, np.asarray(action), float(logp), actor))


def test_a_decision_by_ages_is_explained(tmp_path, capsys):
    ages_only(tmp_path)
    assert main([str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert said.startswith("decision 4: wait ")
    assert "cam02" in said and "in the picture" not in said
    logit, average = re.search(r"logit (\S+); of average cameras (\S+)\)", said).groups()
    shares = [float(share) for share in re.findall(r"^  cam\d+ +(\S+)", said, re.MULTILINE)]
    assert len(shares) == 3 and sum(shares) == pytest.approx(float(logit) - float(average), abs=0.003)
    assert cv2.imread(str(tmp_path / "decision-000004.png")).shape[1] > 500


@NEEDS_ONNX
def test_regions_are_found_with_what_embedded_the_frames(tmp_path, capsys):
    from tests.edge_server.embed.graphs import detector

    model = detector(tmp_path / "d.onnx")
    embedding = {"model": str(model), "dim": 3}
    DecisionWriter(tmp_path, embedding).write(a_decision(2))
    assert main([str(tmp_path), "--decision", "2", "--camera", "cam01"]) == 0
    said = re.search(r"the picture of cam01 most by the region in .* of 8 x 8: (\S+)", capsys.readouterr().out)
    assert abs(float(said[1])) > 0


NO_EMBEDDER = (
    ({"model": "/nowhere/d.onnx", "dim": 3}, "No such file"),
    (None, "does not say what embedded its frames"),
)


@NEEDS_ONNX
@pytest.mark.parametrize(("embedding", "says"), [(NOWHERE, "No such file"), (None, "does not say what embedded")])
def test_where_frames_cannot_be_embedded_again_the_rest_is_told(embedding, says, tmp_path, capsys):
    DecisionWriter(tmp_path, embedding).write(a_decision(2))
    assert main([str(tmp_path)]) == 0
    told = capsys.readouterr()
    assert "by part of the state" in told.out and "in the picture" not in told.out
    assert says in told.err and told.err.count("\n") == 1
    # Whoever asks for a picture is refused.
    assert main([str(tmp_path), "--camera", "cam01"]) == 2
    assert says in capsys.readouterr().err


def test_what_cannot_be_explained_is_said_in_one_line(tmp_path, capsys):
    ages_only(tmp_path)
    for option, value, says in (("--decision", "-1", "is not kept"), ("--camera", "cam01", "looks at no pictures")):
        assert main([str(tmp_path), option, value]) == 2
        error = capsys.readouterr().err
        assert says in error and error.count("\n") == 1
