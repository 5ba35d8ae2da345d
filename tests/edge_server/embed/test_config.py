"""``edge.embedding`` of a scenario: strict, and nothing where they are absent."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge_server.embed import EmbeddingConfig, model_path
from edge_server.settings import read_config
from freshfield.scenario import Scenario, ScenarioError, load, parse

FILE = Path("/somewhere/room.yaml")


def scenario(**edge) -> Scenario:
    return parse({"cameras": {"count": 2}, "edge": edge}, FILE)


def test_defaults_and_values():
    assert read_config(load("room")).embedding is None
    assert read_config(scenario(embedding={})).embedding == EmbeddingConfig()
    found = read_config(scenario(embedding={"dim": 16})).embedding
    assert found.dim == 16
    assert model_path(EmbeddingConfig().model).name == "detector_int8.onnx"


def test_a_model_is_relative_to_the_scenario():
    assert read_config(scenario(embedding={"model": "m/yolo.onnx"})).embedding.model == "/somewhere/m/yolo.onnx"
    assert read_config(scenario(embedding={"model": "/a/yolo.onnx"})).embedding.model == "/a/yolo.onnx"
    assert read_config(scenario(embedding={"model": "default"})).embedding.model == "default"


@pytest.mark.parametrize(
    "section, told",
    [
        ({"dims": 3}, "edge.embedding.dims: unknown key; did you mean 'dim'?"),
        ({"dim": "32"}, "edge.embedding.dim: expected a whole number"),
        ("default", "edge.embedding: expected a mapping"),
    ],
)
def test_one_line_for_what_is_wrong(section, told):
    with pytest.raises(ScenarioError) as caught:
        read_config(scenario(embedding=section))
    assert str(caught.value).startswith(f"{FILE}: {told}") and "\n" not in str(caught.value)
