"""Fits side by side: medians of what was reported, at refined poses where there are some."""

import json

import pytest

from edge_server.experiments.fitting.curves import main


def write_fit(folder, rows):
    folder.mkdir()
    (folder / "series.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def row(t_s, psnr_db, **more):
    return {"t_s": t_s, "psnr_db": psnr_db, "ssim": 0.5, "lpips": 0.2} | more


def test_medians_at_refined_poses(tmp_path):
    refined = [
        write_fit(tmp_path / str(db), [row(1.0, 3.0, psnr_refined_db=db, ssim_refined=0.7)])
        for db in (20.0, 26.0, 22.0)
    ]
    exact = write_fit(tmp_path / "exact", [row(1.0, 30.0, psnr_refined_db=None, lpips=None)])
    fits = ["carried=" + ",".join(map(str, refined)), f"exact={exact}"]
    assert main([*fits, "--out", str(tmp_path / "both")]) == 0
    curves = json.loads((tmp_path / "both.json").read_text())["curves"]
    assert curves["carried"] == {"runs": 3, "t_s": [1.0], "psnr_db": [22.0], "ssim": [0.7], "lpips": [0.2]}
    assert curves["exact"]["psnr_db"] == [30.0] and "lpips" not in curves["exact"]
    assert (tmp_path / "both.png").stat().st_size > 1000


def test_simulations_by_what_was_shown(tmp_path):
    runs = []
    for seed, curve in enumerate(([[0.0, 20.0, None], [0.5, 22.0, 18.0], [1.0, 23.0, 19.0]], [[0.5, 24.0, 19.0]])):
        runs.append(tmp_path / str(seed))
        runs[-1].mkdir()
        found = {"shown_curve_db": curve, "seconds_to_1_db": 0.5 + seed}
        (runs[-1] / "simulation.json").write_text(json.dumps(found))
    assert main([f"quad={runs[0]},{runs[1]}", "--out", str(tmp_path / "shown")]) == 0
    (curve,) = json.loads((tmp_path / "shown.json").read_text())["curves"].values()
    assert curve == {
        "runs": 2,
        "seconds_to_1_db": [0.5, 1.5],
        "t_s": [0.5],
        "psnr_db": [23.0],
        "psnr_moving_db": [18.5],
    }


def test_fits_of_other_instants_are_refused(tmp_path, capsys):
    fits = [write_fit(tmp_path / str(n), [row(1.0, 3.0)] * n) for n in (1, 2)]
    with pytest.raises(SystemExit):
        main([f"two={fits[0]},{fits[1]}", "--out", str(tmp_path / "two")])
    assert "different instants" in capsys.readouterr().err


@pytest.mark.parametrize("missing", [{"psnr_db": None}, {"ssim": None}])
def test_fits_without_a_score_are_refused_by_name_and_instant(missing, tmp_path, capsys):
    fit = write_fit(tmp_path / "gap", [row(1.0, 3.0), row(2.5, 4.0) | missing])
    with pytest.raises(SystemExit):
        main([f"one={fit}", "--out", str(tmp_path / "one")])
    assert f"{fit}: no {next(iter(missing))} at 2.5 s" in capsys.readouterr().err
