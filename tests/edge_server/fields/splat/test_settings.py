"""The Gaussian field's options: wrong ones are named, and all of them listed."""

from __future__ import annotations

import pytest

from edge_server.fields.registry import make_field
from edge_server.fields.splat.settings import EFFORTS, SplatSettings, help_text, make_settings


def test_an_unknown_option_lists_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"no option rays; it has: effort, gaussians, .*device"):
        make_field("splat", {"rays": 4096})


@pytest.mark.parametrize("name, value, text", [
    ("gaussians", 0, "gaussians must be in"), ("harmonics", 2, "1, 4, 9"), ("loss", "huber", "mse, l1"),
    ("device", "tpu", "auto, cpu, cuda"), ("background", "pink", "#80c0ff"), ("radius_m", -1.0, "positive"),
    ("effort", "mad", "low, medium, high"), ("tile_share", 0.0, "tile_share"),
    ("rate_scale", float("nan"), "rate_scale"),
])  # fmt: skip
def test_a_wrong_value_is_refused(name: str, value: object, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        make_settings({name: value})


def test_efforts_and_help() -> None:
    assert (
        make_settings({"effort": "low"}).gaussians == EFFORTS["low"]["gaussians"] < SplatSettings().gaussians
    )
    assert make_settings({"effort": "high", "gaussians": 9}, seed=4) == make_settings(
        {"gaussians": 9, "start": EFFORTS["high"]["start"]}, seed=4
    )
    assert all(help_text().values())
