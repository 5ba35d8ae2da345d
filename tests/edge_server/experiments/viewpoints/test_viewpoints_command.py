"""``edge-server viewpoints``: a plan, its files, and errors for people; the arm's reach in ``cell``."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from matplotlib.axes import Axes

from edge_server.cli import main
from edge_server.experiments.common.arguments import OptionError
from edge_server.experiments.viewpoints.reconstructions import sprites, viewing_path
from edge_server.experiments.viewpoints.stage import open_embedder, open_stage
from edge_server.experiments.viewpoints.viewpoints_command import read_budget
from edge_server.page.preferences import PreferencePage
from edge_server.viewpoints.candidates import half_hemisphere
from edge_server.viewpoints.capture_planner import Budget
from freshfield.geometry import Pinhole
from tests.edge_server.experiments.sets import write_photos


def test_a_capture_is_planned_and_written(tmp_path, capsys, monkeypatch):
    numbers = []
    monkeypatch.setattr(Axes, "annotate", lambda at, text, *place, **how: numbers.append(text))
    words = ["viewpoints", "tile", "--budget", "4,5m", "--candidates", "24", "--steps", "3"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    plan = json.loads((tmp_path / "plan.json").read_text())
    assert plan["views"] == len(plan["stops"]) == 4 and plan["path_m"] <= 5.0 and plan["candidates"] == 24
    assert np.array(plan["stops"][0]["camera_to_world"]).shape == (4, 4)
    assert plan["held_out"]["psnr_db"] > 5.0 and (tmp_path / "plan.png").stat().st_size > 10_000
    assert numbers == ["1", "2", "3", "4"], "the drawing says which comes when"
    said = capsys.readouterr().out
    assert "4 views" in said and "m away" in said and "held out: PSNR" in said


def test_budgets_as_people_type_them():
    assert read_budget("8") == Budget(8) and read_budget("2.5m") == Budget(None, 2.5)
    assert read_budget("8,2.5m") == Budget(8, 2.5)
    with pytest.raises(OptionError):
        read_budget("8 views")


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


def test_what_a_page_shows_is_begun_in_an_empty_folder_and_anew_for_other_steps(tmp_path):
    stage = open_stage("tile", 4, 16)
    about = []
    for steps in (1, 2):
        assert sprites(stage, [], steps, 0, tmp_path / "shown", print) == []
        about.append((tmp_path / "shown/about.json").read_text())
    assert about[0] != about[1]


def test_an_arm_says_which_candidates_it_reaches():
    stage = open_stage("cell", 40, 16)
    reached = stage.candidates.reachable
    assert 20 <= reached.sum() < 40 and 10 <= len(stage.held_out) <= 20
    assert stage.take(int(np.flatnonzero(reached)[0])).image.shape == (16, 16, 3)
    far = np.linalg.norm(stage.candidates.poses[:, :3, 3] - stage.candidates.target, axis=1)
    np.testing.assert_allclose(far, 0.34)


def test_a_transparent_picture_is_embedded_as_it_looks_over_the_background():
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (64, 64, 4), dtype=np.uint8)
    picture[..., 3] = 255 * (picture[..., 3] > 127)
    over_white = np.where(picture[..., 3:] > 0, picture[..., :3], 255).astype(np.uint8)
    white, black = open_embedder((1.0, 1.0, 1.0))[0], open_embedder((0.0, 0.0, 0.0))[0]
    assert white is not None and black is not None
    np.testing.assert_array_equal(white([picture]), black([over_white]))
    assert np.abs(white([picture]) - black([picture])).max() > 0.0


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


@pytest.mark.slow  # 6 s
def test_a_person_is_asked_on_the_page_and_the_next_call_goes_on(tmp_path, monkeypatch):
    """The page's own tests answer; here somebody answers once and finishes."""
    served = []

    class Page(PreferencePage):
        def serve(self, host, port, transport=None):
            served.append(self)
            self._keep(self.session.answered("left"))
            self.session = self.session.answered("left")
            self.finished.set()
            self.seen.set()
            return "http://here", lambda: None

    monkeypatch.setattr("edge_server.page.preferences.PreferencePage", Page)
    words = ["viewpoints", "tile", "--budget", "2", "--candidates", "12", "--steps", "2"]
    words += ["--out", str(tmp_path)]
    for call in (1, 2):
        assert main([*words, "--ask", "--reconstructions", "3"]) == 0
        answers = json.loads((tmp_path / "answers.json").read_text())["answers"]
        assert [a["by"] for a in answers] == ["person"] * call
    lines, png = served[1]._plan
    assert len(lines) == 2 and "the first view" in lines[0] and png == (tmp_path / "plan.png").read_bytes()
    first = cv2.imdecode(np.frombuffer(served[0]._sprites[0], np.uint8), 1)
    assert first.shape == (4 * 128, 6 * 128, 3) and served[0]._sprites == served[1]._sprites
    assert np.abs(first[:128, :128].astype(int) - first[-128:, -128:]).mean() > 1.0  # the viewpoint moves


def test_the_path_of_the_moving_viewpoint_stays_among_the_candidates():
    target = np.array([0.5, 0.0, 1.0])
    candidates = half_hemisphere(target, 0.7, Pinhole.from_fov(16, 16, 50.0), 60)
    path = np.stack(viewing_path(candidates, 9))
    away = path[:, :3, 3] - target
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.7)
    np.testing.assert_allclose(np.einsum("nd,nd->n", path[:, :3, 2], away), -0.7, atol=1e-9)  # looks at it
    nearest = (candidates.directions @ (away / 0.7).T).max(axis=0)
    assert np.rad2deg(np.arccos(nearest)).max() < 20.0
    # One short way, from the left to the right of the picture.
    steps = np.diff(path[:, :3, 3], axis=0)
    assert np.ptp(np.linalg.norm(steps, axis=1)) < 1e-9 and (steps[:, 0] > 0).all()
