"""``bench track``: what follows is compared with what is fitted afresh; all that is measured is kept."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_server.cli import main as edge_server
from edge_server.experiments.bench import track
from edge_server.experiments.bench.track import Workload, gaps
from edge_server.fields import Budget, FitReport, Rendering
from tests.edge_server.experiments.sets import SMALL_WORDS, write_recording

TINY = Workload(updates=3, samples=2, cameras=5, size=24)


class Flat:
    """Shows mid-gray whatever it is given. interrupt: the fit, of all fields', that Ctrl-C falls into."""

    fits = 0
    interrupt: int | None = None

    def fit(self, views: Any, budget: Budget) -> FitReport:
        Flat.fits += 1
        if Flat.fits == Flat.interrupt:
            raise KeyboardInterrupt
        return FitReport(budget.steps or 7, budget.seconds or 0.1, 0.0, 1, 1)

    def render(self, pose: Any, lens: Any) -> Rendering:
        shape = (lens.height, lens.width)
        return Rendering(np.full((*shape, 3), 0.5, np.float32), np.zeros(shape), np.zeros(shape))

    def warm_up(self) -> float:
        return 0.0

    def state(self) -> dict[str, Any]:
        return {}

    def load_state(self, state: Any) -> None:
        pass


@pytest.fixture
def flat(monkeypatch: pytest.MonkeyPatch) -> type[Flat]:
    monkeypatch.setattr(track, "make_field", lambda name, options=None, seed=0: Flat())
    monkeypatch.setattr(track, "QUICK", TINY)
    monkeypatch.setattr(Flat, "fits", 0)
    monkeypatch.setattr(Flat, "interrupt", None)
    return Flat


def bench(path: Path, *words: str) -> int:
    return edge_server(["bench", "track", "--quick", "--out", str(path), "--scene", "room", *words])


def figures(path: Path) -> Any:
    return json.loads((path / "track.json").read_text())["track"]["room"]


def test_a_follower_is_compared_with_fresh_fits_and_everything_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(track, "QUICK", replace(TINY, update_s=(0.1,)))
    monkeypatch.setattr(track, "FRESH_S", 0.5)
    assert bench(tmp_path, "--field", "ngp", *SMALL_WORDS) == 0
    found = figures(tmp_path)["ngp"]
    run = found["0.1_s"]
    assert run["series"]["frame"] == [1, 2, 3] and max(run["series"]["steps"]) >= 1
    assert sorted(found["fresh"]) == ["0", "3"] and found["fresh"]["3"]["steps"] >= 1
    for metric in ("psnr_db", "psnr_moving_db"):
        assert len(set(run["series"][metric])) == 3  # every update was scored on its own
    assert run["whole"]["mean_db"] == pytest.approx(np.mean(run["series"]["psnr_db"]))

    assert (tmp_path / "track.png").read_bytes()[:4] == b"\x89PNG"
    text = (tmp_path / "track.md").read_text()
    assert "![track](track.png)" in text
    row = next(line for line in text.splitlines() if line.startswith("| room | ngp |"))
    cells = [cell.strip() for cell in row.split("|")[1:-1]]
    whole, moving = run["whole"], run["moving"]
    assert cells[2:5] == [f"0.1 s ({run['steps']:.0f} steps)", "3", f"{whole['mean_db']:.2f} ({moving['mean_db']:.2f})"]
    assert cells[5] == f"{whole['fresh_mean_db']:.2f} ({moving['fresh_mean_db']:.2f})"
    assert cells[7] == f"{100 * whole['share_near']:.0f} % ({100 * moving['share_near']:.0f} %)"
    assert cells[8] == f"{whole['median_db']:.2f} ({moving['median_db']:.2f})"
    assert row in capsys.readouterr().out


def test_a_field_that_learns_nothing_is_as_good_as_fresh(tmp_path, monkeypatch, flat):
    """Interpolation is exact at the sampled frames, and every frame is sampled here."""
    monkeypatch.setattr(track, "QUICK", replace(track.QUICK, updates=4, samples=5))
    assert bench(tmp_path, "--field", "ngp") == 0
    found = figures(tmp_path)["ngp"]
    assert set(found) >= {"fresh", "1_s", "0.25_s"}
    for kind in ("whole", "moving"):
        gap = found["1_s"][kind]
        assert gap["share_near"] == 1.0
        assert gap["median_db"] == pytest.approx(0.0, abs=1e-12)
        assert gap["drift_db"] == pytest.approx(0.0, abs=1e-12)
    fresh = found["fresh"]["4"]
    assert fresh["psnr_db"] == fresh["not_updated_psnr_db"] and fresh["fitted_s"] == 15.0


def test_gaps_are_against_the_interpolated_fresh_fits():
    frames = list(range(1, 21))
    # Fresh falls from 30 to 20 dB; the follower starts with it and loses 0.1 dB more at every frame.
    fresh = {0: 30.0, 20: 20.0}
    tracked: list[float | None] = [30.0 - 0.5 * f - 0.1 * f for f in frames]
    found = gaps(frames, tracked, fresh)
    assert found["share_near"] == pytest.approx(5 / 20)
    assert found["median_db"] == pytest.approx(1.05)
    assert found["first_tenth_db"] == pytest.approx(0.15)
    assert found["last_tenth_db"] == pytest.approx(1.95)
    assert found["drift_db"] == pytest.approx(1.8)
    assert found["fresh_mean_db"] == pytest.approx(np.mean([30.0 - 0.5 * f for f in frames]))
    # Frames without a score (nothing moved) have no vote.
    some = [v if f % 2 else None for f, v in zip(frames, tracked)]
    assert gaps(frames, some, fresh)["share_near"] == pytest.approx(3 / 10)
    assert gaps(frames, [None] * 20, fresh)["median_db"] is None
    assert gaps(frames, tracked, {})["share_near"] is None


def test_an_interrupted_bench_keeps_what_it_has_and_goes_on(tmp_path, flat, monkeypatch, capsys):
    words = ("--field", "ngp,tensorf")
    flat.interrupt = 2 + 2 * 3 + 2 + 2  # the second update of tensorf's first run
    assert bench(tmp_path, *words) == 130
    assert "the same command goes on" in capsys.readouterr().out
    (kept,) = map(json.loads, (tmp_path / "results.jsonl").read_text().splitlines())
    assert kept["inputs"]["field"] == "ngp"

    flat.interrupt, flat.fits = None, 0
    assert bench(tmp_path, *words) == 0
    assert flat.fits == 2 + 2 * 3  # tensorf's alone
    rows = figures(tmp_path)
    assert rows["ngp"] == kept["result"] and rows["tensorf"]["0.25_s"]["series"]["frame"] == [1, 2, 3]

    # Other settings are other figures.
    monkeypatch.setattr(track, "QUICK", replace(TINY, updates=2))
    assert bench(tmp_path, *words) == 0
    assert figures(tmp_path)["ngp"]["1_s"]["updates"] == 2


def test_recordings_are_followed_too(tmp_path, flat, monkeypatch):
    write_recording(tmp_path / "blender_kitchen", cameras=5, instants=4, size=24)
    monkeypatch.setenv("FRESHFIELD_DATA", str(tmp_path))
    words = ["bench", "track", "--quick", "--field", "ngp", "--scene", "kitchen", "--out", str(tmp_path / "out")]
    assert edge_server(words) == 0
    found = json.loads((tmp_path / "out" / "track.json").read_text())["track"]["kitchen"]
    assert found["scene"] == "kitchen: 4 views of 24 x 24" and found["ngp"]["1_s"]["updates"] == 3
    assert found["baseline"]["mean_colour_db"] > 0.0
