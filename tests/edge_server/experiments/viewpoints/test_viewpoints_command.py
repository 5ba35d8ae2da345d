"""``edge-server viewpoints``: a plan, its files, and errors for people; the arm's reach in ``cell``."""

import json

import numpy as np
import pytest

from edge_server.cli import main
from edge_server.experiments.viewpoints.reconstructions import varied_plan
from edge_server.experiments.viewpoints.stage import open_stage
from tests.edge_server.experiments.sets import write_photos


def test_a_capture_is_planned_and_written(tmp_path):
    words = ["viewpoints", "tile", "--budget", "4,5m", "--candidates", "24", "--steps", "3"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    plan = json.loads((tmp_path / "plan.json").read_text())
    assert plan["views"] == len(plan["stops"]) == 4 and plan["path_m"] <= 5.0 and plan["candidates"] == 24
    assert np.array(plan["stops"][0]["camera_to_world"]).shape == (4, 4)
    assert plan["held_out"]["psnr_db"] > 5.0 and (tmp_path / "plan.png").stat().st_size > 10_000


@pytest.mark.parametrize("alpha", [False, True])
def test_candidates_of_a_recording_are_its_training_views_and_transparent_ones_stand_before_white(tmp_path, alpha):
    write_photos(tmp_path / "set", 9, alpha=alpha)
    (tmp_path / "own.yaml").write_text("source: {kind: transforms, data: set, scale: 2}\ncameras: {count: 2}\n")
    stage = open_stage(str(tmp_path / "own.yaml"), data=tmp_path)
    assert (len(stage.candidates), len(stage.held_out)) == (7, 2)
    view = stage.take(3)
    assert view is stage.recorded[3] and view.image.shape == (16, 16, 4 if alpha else 3)
    np.testing.assert_allclose(stage.candidates.poses[3], view.camera_to_world)
    assert (stage.background, stage.options) == (((1.0,) * 3, {"background": "white"}) if alpha else ((0.0,) * 3, {}))


def test_an_arm_says_which_candidates_it_reaches(monkeypatch):
    stage = open_stage("cell", 40, 16)
    reached = stage.candidates.reachable
    assert 20 <= reached.sum() < 40 and 10 <= len(stage.held_out) <= 20
    assert stage.take(int(np.flatnonzero(reached)[0])).image.shape == (16, 16, 3)
    far = np.linalg.norm(stage.candidates.poses[:, :3, 3] - stage.candidates.target, axis=1)
    np.testing.assert_allclose(far, 0.34)
    few = stage.candidates.directions @ stage.candidates.directions[np.flatnonzero(reached)[0]] > 0.85
    stage.candidates = stage.candidates.within(few)
    assert 4 <= stage.candidates.reachable.sum() < 12
    assert {len(varied_plan(stage, k, 4).order) for k in range(30)} == {4}
    monkeypatch.setattr(f"{open_stage.__module__}._arm_reaches", lambda *of: np.full(len(of[2]), len(of[2]) == 40))
    assert len(open_stage("cell", 40, 16).held_out) == 20, "something is scored"


@pytest.mark.slow
def test_a_simulated_expert_is_asked_and_a_policy_plans_by_its_answers(tmp_path, capsys):
    words = ["viewpoints", "tile", "--budget", "3", "--candidates", "16", "--steps", "2"]
    words += ["--out", str(tmp_path)]
    few = ["--reconstructions", "5", "--ask", "object", "--questions"]
    assert main([*words, *few, "4"]) == 0
    said = capsys.readouterr().out
    assert "it does not know" in said and "planned by coverage instead" in said  # four answers are too few
    answers = json.loads((tmp_path / "answers.json").read_text())["answers"]
    assert len(answers) == 4 and {a["by"] for a in answers} == {"simulated expert (object)"}
    assert main([*words, *few, "60"]) == 0  # goes on
    file = json.loads((tmp_path / "answers.json").read_text())
    assert file["answers"][:4] == answers and len(file["answers"]) == 60
    assert "planned by" not in capsys.readouterr().out
    assert json.loads((tmp_path / "plan.json").read_text())["selector"] == "ppo"
    assert main([*words, "--selector", f"ppo:{tmp_path / 'policy.npz'}"]) == 0
    assert main([*words, *few, "60", "--seed", "1"]) == 2
    assert "about other reconstructions" in capsys.readouterr().err and len(file["answers"]) == 60
