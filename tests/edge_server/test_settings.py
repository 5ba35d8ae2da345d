"""What an ``edge:`` section leaves open is chosen by what the cameras do, and what it says always wins."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge_server.settings import MOST_CARRIED, SCAN, EdgeConfig, KeyframesConfig, cameras_move, described, read_config
from freshfield.scenario import ScenarioError, parse

STILL = EdgeConfig("splat", {"layers": True}, updates="arrivals", update_ms=20.0, steps=10)
MOVING = EdgeConfig("splat", SCAN, updates="cycle", update_ms=80.0, steps=8)
MANY_MOVING = EdgeConfig("splat", updates="cycle", update_ms=800.0, steps=100, keyframes=KeyframesConfig(32, 0.03, 5.0))


def scenario(edge=None, **source):
    return parse({"cameras": {"count": 3}, "source": source, "edge": edge}, Path("x.yaml"))


@pytest.mark.parametrize("edge", [None, {}])
def test_an_empty_section_works_in_layers_before_fixed_cameras_and_as_a_scan_before_moving_ones(edge):
    assert read_config(scenario(edge)) == STILL
    assert read_config(scenario(edge), moving=True) == MOVING
    assert SCAN == {"scan": True, "refine": True, "carried": True, "gaussians": 60_000}
    assert read_config(parse({"cameras": {"count": 3}}, Path("x.yaml"))) == STILL
    for count, expected in ((MOST_CARRIED, MOVING), (MOST_CARRIED + 1, MANY_MOVING)):
        assert read_config(parse({"cameras": {"count": count}}, Path("x.yaml")), moving=True) == expected


@pytest.mark.parametrize("key", ["arm", "trajectory"])
def test_cameras_that_an_arm_or_a_trajectory_carries_are_known_to_move(key):
    assert cameras_move(scenario(**{key: {"host": "127.0.0.2"}})) and not cameras_move(scenario())
    assert read_config(scenario(**{key: {}})) == MOVING
    assert read_config(scenario(**{key: {}}), moving=False) == STILL


@pytest.mark.parametrize(
    ("edge", "still", "moving"),
    [
        ({"updates": "cycle"}, (False, "cycle", 800.0, 100, False), (False, "cycle", 800.0, 100, True)),
        ({"update_ms": 50}, (True, "arrivals", 50.0, 10, False), (False, "cycle", 50.0, 8, False)),
        ({"field": "ngp"}, (False, "cycle", 800.0, 100, False), (False, "cycle", 800.0, 100, True)),
        ({"field_options": {"layers": False}}, (False, "cycle", 800.0, 100, False), (False, "cycle", 80.0, 8, False)),
        ({"field_options": {"layers": True}}, (True, "arrivals", 20.0, 10, False), (True, "arrivals", 20.0, 10, False)),
        ({"field_options": {"gaussians": 900}}, (True, "arrivals", 20.0, 10, False), (False, "cycle", 80.0, 8, False)),
        ({"keyframes": None}, (True, "arrivals", 20.0, 10, False), (False, "cycle", 800.0, 100, False)),
        ({"keyframes": {"most": 5}}, (True, "arrivals", 20.0, 10, True), (False, "cycle", 800.0, 100, True)),
    ],
)
def test_what_a_scenario_says_wins(edge, still, moving):
    for expected, moves in ((still, False), (moving, True)):
        found = read_config(scenario(edge), moving=moves)
        layers = bool(found.field_options.get("layers"))
        assert (layers, found.updates, found.update_ms, found.steps, found.keyframes is not None) == expected
        scan = SCAN if found.field_options.get("carried") else {}
        assert {k: v for k, v in found.field_options.items() if k != "layers"} == {
            k: v for k, v in {**scan, **edge.get("field_options", {})}.items() if k != "layers"
        }
    if edge.get("keyframes"):
        assert found.keyframes.most == 5


def test_a_section_of_another_kind_is_refused_by_name():
    for edge, named in (({"field_options": 3}, "field_options"), ([], "edge"), ({"field": 3}, "field")):
        with pytest.raises(ScenarioError, match=f"x.yaml: .*{named}"):
            read_config(scenario(edge))


def test_one_line_says_what_was_chosen_and_why():
    at = scenario({})
    assert described(at, MOVING, "cam01") == "splat as a scan, updated in a cycle for 80 ms: cam01 moves"
    given = {"field": "ngp", "updates": "cycle", "update_ms": 300, "keyframes": None}
    line = described(scenario(given), read_config(scenario(given)), "")
    assert line == (
        "ngp, updated in a cycle for 300 ms: no camera moves; the scenario sets field, updates, update_ms, keyframes"
    )
