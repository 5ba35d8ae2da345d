"""Fits, by a command and as a library has them: what they write, going on, stopping, refusing."""

import json
import os
import signal
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import freshfield as ff
from edge_server.cli import main as edge_server
from edge_server.experiments.fitting.ctrl_c import postponed
from edge_server.experiments.fitting.fit import marks_s
from edge_server.experiments.scenes.multiview_still import WHITE, mean_baselines, open_still
from edge_server.export import ExportError
from edge_server.fidelity.images import BLACK
from edge_server.fields import checkpoint
from edge_server.fields.common.training_schedule import StepBudget
from edge_server.report.build_report import build_report
from freshfield.geometry import look_at
from tests.edge_server.experiments.sets import SMALL_WORDS, write_photos
from tests.support import refused


def fit(data, out, *words: str) -> int:
    return edge_server(["fit", str(data), "--out", str(out), *SMALL_WORDS, *words])


def report_of(out):
    return json.loads((out / "report.json").read_text())


def test_it_learns_goes_on_and_leaves_report_pictures_and_checkpoint(tmp_path, capsys):
    write_photos(tmp_path / "set", 9)
    out = tmp_path / "out"
    assert fit(tmp_path / "set", out, "--seconds", "1", "--seed", "3") == 0
    before = report_of(out)["fidelity"]["series"]
    assert fit(tmp_path / "set", out, "--seconds", "2.5", "--seed", "3", "--resume") == 0
    report = report_of(out)
    assert report["frames"] is None, "no frame passed a network"
    series = report["fidelity"]["series"]
    assert series[: len(before)] == before
    assert before[-1]["t_s"] < series[-1]["t_s"] == pytest.approx(2.5, rel=0.2)
    assert series[-1]["psnr_db"] > report["fidelity"]["baseline"]["mean_color_db"] + 1.0
    for name in ("report.html", "truth.png", "rendered.png", "figure-comparison.png", "figure-fidelity.png"):
        assert (out / name).stat().st_size > 100, name
    state, about = checkpoint.load(out / "field")
    assert state and about["seconds"] == series[-1]["t_s"]
    assert fit(tmp_path / "set", out, "--seconds", "2.5", "--resume") == 2
    assert "give more --seconds" in capsys.readouterr().err
    assert fit(tmp_path / "set", out, "--seconds", "5", "--resume", "--holdout", "3") == 2
    assert "has learned" in (said := capsys.readouterr().err) and "give the --holdout that it began with" in said


@pytest.mark.parametrize("words", [SMALL_WORDS, ["--field", "splat", "--option", "layers=true"]])
def test_ctrl_c_amid_a_slice_keeps_its_steps(tmp_path, capsys, monkeypatch, words):
    def end_third(budget, end=StepBudget.end_step):
        end(budget)
        if budget.steps == 3:
            raise KeyboardInterrupt

    write_photos(tmp_path / "set", 5)
    monkeypatch.setattr(StepBudget, "end_step", end_third)
    assert edge_server(["fit", str(tmp_path / "set"), "--out", str(tmp_path / "out"), *words, "--seconds", "5"]) == 0
    assert "stopped early" in (said := capsys.readouterr().out) and "3 steps" in said
    assert checkpoint.load(tmp_path / "out" / "field")[1]["steps"] == 3


def test_a_scene_of_ours_is_fitted_by_its_name(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert edge_server(["fit", "tower", *SMALL_WORDS, "--seconds", "1", "--scale", "4", "--frame", "6"]) == 0
    assert "tower: 18 views of 32 x 32, at 0.4 s, 1 held out" in capsys.readouterr().out
    assert report_of(tmp_path / "runs" / "fit-tower")["fidelity"]["series"][-1]["psnr_db"] > 10.0


@pytest.mark.parametrize("timed", [True, False])
def test_one_carried_camera_is_a_scan_and_frames_with_times_are_refined(tmp_path, capsys, timed):
    path = write_photos(tmp_path / "set", 9, more=lambda k: {"time": 0.5 * k} if timed else {})
    out = tmp_path / "out"
    words = ["--seconds", "1", "--option", "threads=1", "--option", "start=64", "--option", "seed_cells=16"]
    assert edge_server(["fit", str(path), "--out", str(out), "--field", "splat", *words]) == 0
    report, printed = report_of(out), capsys.readouterr().out
    final = report["fidelity"]["final"]
    assert "a scan: one camera" in report["chosen"] and ("refined" in report["chosen"]) == timed
    assert (final["psnr_refined_db"] is not None) == timed == ("at refined poses" in printed)
    state, _ = checkpoint.load(out / "field")
    assert json.loads(str(state["meta"]))["settings"]["gaussians"] == 8192


@pytest.mark.parametrize("presses", [1, 2])
def test_the_first_ctrl_c_while_it_saves_lets_it_finish(tmp_path, capsys, monkeypatch, presses):
    def pressed(folder):
        for _ in range(presses):
            os.kill(os.getpid(), signal.SIGINT)
        return build_report(folder)

    write_photos(tmp_path / "set", 5)
    out, before = tmp_path / "out", signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patch:
        patch.setattr("edge_server.report.build_report.build_report", pressed)
        status = fit(tmp_path / "set", out, "--seconds", "0.5")
    said = capsys.readouterr()
    assert signal.getsignal(signal.SIGINT) is before
    assert f"writing {out}; Ctrl-C again stops that" in said.err
    if presses == 1:
        assert status == 0 and said.out.rstrip().endswith("report.html") and "stopped" not in said.out
    else:
        assert status == 130 and f"stopped; {out} is written in part; edge-server report {out}" in said.out
        assert not (out / "report.json").exists()
        assert edge_server(["report", str(out)]) == 0
    assert report_of(out)["seconds"] > 0.0 and (out / "report.html").exists()


@pytest.mark.parametrize(("options", "shown", "other"), [((), WHITE, BLACK), (("background=black",), BLACK, WHITE)])
def test_transparent_images_are_scored_over_white_or_the_color_that_is_asked_for(tmp_path, options, shown, other):
    write_photos(tmp_path / "set", 5, alpha=True)
    given = [word for option in options for word in ("--option", option)]
    assert fit(tmp_path / "set", tmp_path / "out", "--seconds", "0.5", *given) == 0
    still, found = open_still(tmp_path / "set"), report_of(tmp_path / "out")["fidelity"]["baseline"]
    assert found == mean_baselines(still.training, still.held_out, shown)
    assert found != mean_baselines(still.training, still.held_out, other)


def test_marks_end_with_the_whole_and_leave_a_long_last_slice():
    assert marks_s(60.0) == [1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 60.0]
    assert marks_s(0.5) == [0.5]
    assert marks_s(45.0)[-2:] == [20.0, 45.0]


SMALL_SPLAT = {"gaussians": 512, "start": 256, "seed_cells": 16, "threads": 1}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[ff.Fit, object]:
    folder = tmp_path_factory.mktemp("fit")
    write_photos(folder / "set", 9)
    seen = []
    data = ff.load(folder / "set", holdout=3, scale=2)
    fit = ff.fit(data, seconds=1.0, field="splat", options=SMALL_SPLAT, progress=seen.append)
    assert seen == fit.rows and len(data.held_out) == 3 and fit._scored_views is data.held_out
    fit.save(folder / "out")
    return fit, folder


def test_what_was_saved_loads_and_renders_the_same(made):
    fit, folder = made
    again = ff.load(folder / "out")
    pose = look_at((0.3, 0.1, 0.4), (0.0, 0.0, 0.0))
    color, depth = fit.render(pose, size=(40, 30)), fit.depth(pose, size=(40, 30))
    assert color.shape == (30, 40, 3) and color.dtype == np.float32 and 0.0 <= color.min() <= color.max() <= 1.0
    assert depth.shape == (30, 40) and depth.max() > 0.0
    np.testing.assert_array_equal(again.render(pose, size=(40, 30)), color)
    assert fit.seed == ff.Fit(fit.data, "splat", SMALL_SPLAT).seed == 0
    assert fit.psnr.shape == (len(fit.rows), 2) and fit.psnr[-1, 0] == pytest.approx(1.0, rel=0.3)
    (folder / "rendered.png").symlink_to("/dev/full")
    refused(OSError, "No space left", fit.save, folder)


def test_ctrl_c_stays_as_it_is_outside_of_the_main_thread():
    def inside():
        with postponed("wait"):
            return signal.getsignal(signal.SIGINT)

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(inside).result() is signal.getsignal(signal.SIGINT)


@pytest.mark.stability
@pytest.mark.parametrize("camera", ["nobody", np.eye(3), np.full((4, 4), np.nan)])
def test_what_is_no_camera_is_refused(made, camera):
    refused(ExportError, "camera", made[0].render, camera)
    refused(ExportError, "expected pixels", made[0].render, np.eye(4), size=(0, 10**6))
