"""Scenario files: strict, with one clear line for everything that is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from freshfield.limits import MAX_IMAGE_SIDE_PX
from freshfield.scenario import ScenarioError, load, parse

FILE = Path("s.yaml")


def test_a_whole_file(tmp_path):
    file = tmp_path / "try.yaml"
    file.write_text("seed: 5\ncameras: {ids: [left, right, top], held_out: [top]}\nsource: {kind: world}\n")
    s = load(file)
    assert (s.name, s.seed, s.cameras, s.held_out) == ("try", 5, ("left", "right", "top"), ("top",))
    assert s.training == ("left", "right") and s.source == {"kind": "world"} and s.channel == {}
    assert load(file, seed=9).seed == 9


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1, 2]", "expected a mapping"),
        ("cameras: {count: 2}\nsede: 3", "sede: unknown key; did you mean 'seed'"),
        ("{}", "either count"),
        ("cameras: {count: 1001}", "cameras.count: expected a whole number, 0 to 1000"),
        ("cameras: {count: 2, ids: [a, b]}", "either count"),
        ("cameras: {ids: [a, a]}", "same id twice"),
        ("cameras: {ids: ['a/b']}", "'a/b' is not an id"),
        ("cameras: {count: 2, held_out: [cam02]}", "'cam02' is not one of the cameras"),
        ("cameras: {count: 1, held_out: [cam00]}", "every camera is held out"),
    ],
)
def test_errors_are_one_line_with_the_file(tmp_path, text, message):
    file = tmp_path / "s.yaml"
    file.write_text(text)
    with pytest.raises(ScenarioError, match=message) as error:
        load(file)
    assert str(error.value).startswith(str(file)) and "\n" not in str(error.value)


def test_shipped_ones_go_by_name_and_a_missing_file_lists_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room").mkdir()  # hides nothing
    assert len(load("room").cameras) == 13 and load("room").held_out == ("cam00",)
    with pytest.raises(ScenarioError, match=r"shipped scenarios: .*room"):
        load("no-such-scenario")


def test_random_streams_are_independent_of_the_number_of_cameras():
    few, many = (parse({"seed": 3, "cameras": {"count": n}}, FILE) for n in (2, 9))
    assert (few.rng("noise", "cam01").random(8) == many.rng("noise", "cam01").random(8)).all()
    draws = {}
    for seed in (0, 1, 2**32):
        scenario = parse({"seed": seed, "cameras": {"count": 3}}, FILE)
        for purpose in ("noise", "noise ", "link"):
            for camera in ("cam00", "cam01", None):
                draws[purpose, camera, seed] = tuple(scenario.rng(purpose, camera).random(3))
    assert len(set(draws.values())) == len(draws) == 27
    assert np.corrcoef(few.rng("a").random(4000), few.rng("b").random(4000))[0, 1] < 0.06


def test_phases_of_cameras(tmp_path):
    cameras = {"count": 3}
    assert parse({"cameras": cameras}, tmp_path / "a.yaml").phase_ns("cam01", 15.0) == 0
    spread = parse({"cameras": {**cameras, "phase": "spread"}, "seed": 1}, tmp_path / "a.yaml")
    phases = [spread.phase_ns(camera, 15.0) for camera in spread.cameras]
    assert len(set(phases)) == 3 and all(0 <= phase < 1e9 / 15 for phase in phases)
    with pytest.raises(ScenarioError, match=r"cameras\.phase: expected one of locked, spread, got 'shifted'"):
        parse({"cameras": {**cameras, "phase": "shifted"}}, tmp_path / "a.yaml")


def test_images_are_as_large_as_the_source_says_and_else_bounded():
    def largest(**source):
        return parse({"cameras": {"count": 2}, "source": source}, FILE).max_side_px

    assert largest(width=128, height=96) == 128 and largest(width=96, height=128) == 128
    assert largest(kind="camera", width=128, height=96) == MAX_IMAGE_SIDE_PX
    assert largest() == largest(width=128) == largest(width="128", height=0) == MAX_IMAGE_SIDE_PX
