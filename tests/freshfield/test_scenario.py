"""Scenario files and their sections: strict, with one clear line for everything that is wrong."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pytest
from msgspec import field

from freshfield.limits import MAX_IMAGE_SIDE_PX
from freshfield.scenario import ScenarioError, load, parse
from freshfield.settings import Settings, as_mapping, read_settings, within
from tests.support import refused

FILE = Path("s.yaml")


def test_a_whole_file(tmp_path):
    file = tmp_path / "try.yaml"
    file.write_text("seed: 5\ncameras: {ids: [left, right, top], held_out: [top]}\nsource: {kind: world}\n")
    s = load(file)
    assert (s.name, s.seed, s.cameras, s.held_out) == ("try", 5, ("left", "right", "top"), ("top",))
    assert s.training == ("left", "right") and s.source == {"kind": "world"} and s.channel == {}
    assert load(file, seed=9).seed == 9


def test_errors_are_one_line_with_the_file(tmp_path):
    for text, message in (
        ("[1, 2]", "expected a mapping"),
        ("cameras: {count: 2}\nsede: 3", "sede: unknown key; did you mean 'seed'"),
        ("cameras: {count: 1001}", "cameras.count: expected a whole number, 0 to 1000"),
        ("cameras: {ids: [a, a]}", "same id twice"),
        ("cameras: {ids: ['a/b']}", "'a/b' is not an id"),
        ("cameras: {count: 2, held_out: [cam02]}", "'cam02' is not one of the cameras"),
    ):
        file = tmp_path / "s.yaml"
        file.write_text(text)
        assert str(refused(ScenarioError, message, load, file)).startswith(str(file))


def test_shipped_ones_go_by_name_and_a_missing_file_lists_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room").mkdir()  # hides nothing
    assert len(load("room").cameras) == 13 and load("room").held_out == ("cam00",)
    refused(ScenarioError, r"shipped scenarios: .*room", load, "no-such-scenario")


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


class Inner(Settings, frozen=True):
    rate: float
    name: str = "x"


class Outer(Settings, frozen=True):
    count: int = 1
    on: bool = False
    share: float | None = None
    size: tuple[int, int] = (1, 1)
    inner: Inner | None = None
    level: Annotated[int, within(0, 10, "of noise")] = 3
    mode: Literal["mean", "max"] = "mean"
    tags: list[str] = field(default_factory=list)
    table: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.count < 0:
            raise ValueError("count cannot be negative")


def test_a_mapping_becomes_a_struct():
    given = {"share": 1, "size": [3, 4], "inner": {"rate": 2}, "tags": ["a"], "table": {"k": 0.5}}
    assert read_settings(Outer, given, "s: x") == Outer(1, False, 1.0, (3, 4), Inner(2.0), 3, "mean", ["a"], {"k": 0.5})
    found = read_settings(Outer, given, "s: x")
    assert read_settings(Outer, as_mapping(found), "s: x") == found


def test_sections_refuse_by_name():
    for given, message in (
        ({"cuont": 1}, r"s: x\.cuont: unknown key; did you mean 'count'"),
        ({"count": 1.0}, r"s: x\.count: expected a whole number"),
        ({"share": float("inf")}, r"s: x\.share: expected a number"),
        ({"size": [1, "b"]}, r"s: x\.size\[1\]: expected a whole number"),
        ({"level": 11}, r"s: x\.level: expected a whole number, 0 to 10, got 11"),
        ({"tags": [7]}, r"s: x\.tags\[0\]: expected text, got 7: put it in quotes"),
        ({"count": -1}, r"s: x: count cannot be negative"),
    ):
        refused(ScenarioError, message, read_settings, Outer, given, "s: x")
