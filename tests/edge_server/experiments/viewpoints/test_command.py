"""``edge-server viewpoints``: a plan, its files, and errors for people; the arm's reach in ``cell``."""

from __future__ import annotations

import json

import numpy as np
import pytest

from edge_server.cli import main
from edge_server.experiments.common.arguments import OptionError
from edge_server.experiments.viewpoints.command import read_budget
from edge_server.experiments.viewpoints.stage import open_stage
from edge_server.viewpoints.plan import Budget


def test_a_capture_is_planned_and_written(tmp_path, capsys):
    words = ["viewpoints", "tile", "--budget", "4,5m", "--candidates", "24", "--steps", "3"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    plan = json.loads((tmp_path / "plan.json").read_text())
    assert plan["views"] == len(plan["stops"]) == 4 and plan["path_m"] <= 5.0 and plan["candidates"] == 24
    assert np.array(plan["stops"][0]["camera_to_world"]).shape == (4, 4)
    assert plan["held_out"]["psnr_db"] > 5.0 and (tmp_path / "plan.png").stat().st_size > 10_000
    said = capsys.readouterr().out
    assert "4 views" in said and "m away" in said and "held out: PSNR" in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["tile", "--budget", "many"], "expected views"),
        (["tile", "--budget", "0"], "at least 1 view"),
        (["tile", "--budget", "4", "--selector", "best"], "no selector is called"),
        (["tile", "--budget", "4", "--travel", "-1"], "--travel"),
        (["nowhere", "--budget", "4"], "nowhere"),
        (["tower", "--budget", "4"], "its cameras look outward"),
    ],
)
def test_wrong_requests_say_what_was_expected(words, said, capsys, tmp_path):
    assert main(["viewpoints", *words, "--out", str(tmp_path)]) == 2
    assert said in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_budgets_as_people_type_them():
    assert read_budget("8") == Budget(8) and read_budget("2.5m") == Budget(None, 2.5)
    assert read_budget("8,2.5m") == Budget(8, 2.5)
    with pytest.raises(OptionError):
        read_budget("8 views")


def test_an_arm_says_which_candidates_it_reaches():
    stage = open_stage("cell", 40, 16)
    reached = stage.candidates.reachable
    assert 20 <= reached.sum() < 40 and 10 <= len(stage.held_out) <= 20
    assert stage.take(int(np.flatnonzero(reached)[0])).image.shape == (16, 16, 3)
    far = np.linalg.norm(stage.candidates.poses[:, :3, 3] - stage.candidates.target, axis=1)
    np.testing.assert_allclose(far, 0.34)
