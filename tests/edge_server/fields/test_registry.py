"""Fields by name: lazily imported, options checked."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import Any

import pytest

from edge_server.fields import Budget
from edge_server.fields.ngp.field import NgpField
from edge_server.fields.ngp.settings import EFFORTS, NgpSettings, help_text, make_settings
from edge_server.fields.registry import field_names, make_field, option_help


def test_make_field_passes_options_and_seed() -> None:
    field = make_field("ngp", {"levels": 3, "log2_table": 9, "device": "cpu", "centre_m": [1, 2, 3]}, seed=5)
    assert isinstance(field, NgpField) and field.settings.levels == 3 and field.settings.seed == 5
    assert field.settings.centre_m == (1.0, 2.0, 3.0) and "ngp" in field_names()


def test_unknown_names_list_the_valid_ones() -> None:
    with pytest.raises(ValueError, match="there are: ngp"):
        make_field("gaussians")
    with pytest.raises(ValueError, match=r"no option levles, rats; it has: effort, levels, .*threads"):
        make_field("ngp", {"levles": 3, "rats": 4})
    with pytest.raises(ValueError, match="low, medium, high"):
        make_field("ngp", {"effort": "heroic"})
    with pytest.raises(ValueError, match=r"levels must be in 1..24, not 99"):
        make_field("ngp", {"levels": 99})
    with pytest.raises(ValueError, match="background"):
        make_field("ngp", {"background": "blu"})


@pytest.mark.parametrize("name", field_names())
@pytest.mark.parametrize(
    ("option", "text"),
    [
        ({"rays": "many"}, "rays must be a whole number, not 'many'"),
        ({"gaussians": 100.5}, "gaussians must be a whole number, not 100.5"),
        ({"cells": 64.0}, "cells must be a whole number"),
        ({"nice": "x"}, "nice must be a whole number"),
        ({"seed": True}, "seed must be a whole number"),
        ({"contracted": "yes"}, "contracted must be true or false, not 'yes'"),
        ({"exposure": "no"}, "exposure must be true or false"),
        ({"rate_end": float("nan")}, "rate_end must be a finite number"),
        ({"epsilon": "small"}, "epsilon must be a number, not 'small'"),
        ({"background": 3}, "background must be text"),
        ({"centre_m": [1, 2]}, "centre_m must be a list of 3 numbers"),
        ({"centre_m": 5}, "centre_m must be a list of 3 numbers"),
        ({"effort": ["high"]}, "effort must be a name"),
    ],
)
def test_options_of_another_type_are_refused(name: str, option: dict, text: str) -> None:
    if not set(option) <= {"effort", *option_help(name)}:
        pytest.skip(f"{name} has no {', '.join(option)}")
    with pytest.raises(ValueError, match=f"{name}: {text}"):
        make_field(name, option)


@pytest.mark.parametrize("name", field_names())
@pytest.mark.parametrize(
    ("option", "value", "text"),
    [
        ("rate", -1.0, "in 0.0..10.0"), ("rate_net", -1.0, "in 0.0..10.0"),
        ("rate_color", -1.0, "in 0.0..10.0"), ("rate_end", 0.0, "in 0.0001..1.0"),
        ("rate_end", -0.1, "in 0.0001..1.0"),
        ("epsilon", 0.0, "in 1e-10..1000.0"), ("epsilon", -1.0, "in 1e-10..1000.0"),
        ("changed_share", 7.0, "in 0.0..1.0"), ("distortion", -5.0, "in 0.0..1000.0"),
        ("sparsity", -1.0, "in 0.0..1000.0"), ("sparse", -1.0, "in 0.0..1000.0"),
        ("near_fade", -1.0, "in 0.0..10.0"), ("depth_guide", -1.0, "in 0.0..1000.0"),
        ("guide_steps", 0, "in 1..1073741824"),
        ("decay", -1.0, "in 0.0..1000.0"),
        ("smooth", -1.0, "in 0.0..1000.0"), ("levels_start", 0, "in 1..24"),
        ("prune_from", -1, "in 0..1073741824"), ("batch_samples", 2049, "a multiple of 2048"),
        ("threads", 0, "in 1..1024"), ("nice", -1, "in 0..19"), ("seed", -1, "in 0..9223372036854775807"),
    ],
)  # fmt: skip
def test_what_no_field_can_work_with_is_refused(name: str, option: str, value: float, text: str) -> None:
    if option not in option_help(name):
        pytest.skip(f"{name} has no {option}")
    with pytest.raises(ValueError, match=re.escape(f"{name}: {option} must be {text}, not {value}")):
        make_field(name, {option: value})


@pytest.mark.parametrize("wrong", [{"seconds": float("nan")}, {"seconds": float("inf")}, {"steps": -1}, {}])
def test_a_budget_without_an_end_is_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match="a budget is"):
        Budget(**wrong)


def test_a_number_that_yaml_takes_for_text_is_one() -> None:
    field = make_field("ngp", {"rate": "1e-3", "radius_m": None, "device": "cpu"})
    assert isinstance(field, NgpField) and field.settings.rate == 1e-3 and field.settings.radius_m is None


def test_efforts_are_ordered_and_can_be_overridden() -> None:
    low, medium, high = (make_settings({"effort": e}) for e in EFFORTS)
    assert low.samples < medium.samples < high.samples
    assert low.batch_samples < medium.batch_samples < high.batch_samples and medium == NgpSettings()
    assert make_settings({"effort": "high", "samples": 33}).samples == 33


def test_every_option_has_help() -> None:
    assert all(len(text) > 10 for text in help_text().values())


def test_the_registry_imports_no_representation_by_itself() -> None:
    code = (
        "import sys, edge_server.fields.registry; print([m for m in sys.modules if m in ('numba', 'torch')])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def imports_torch(device: str) -> bool:
    code = (
        "import sys; from edge_server.fields.registry import make_field;"
        f"make_field('ngp', {{'device': '{device}'}}); print('torch' in sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return out.stdout.strip() == "True"


def test_the_cpu_needs_no_torch() -> None:
    assert not imports_torch("cpu")


def test_auto_means_the_cpu_and_needs_no_torch() -> None:
    assert not imports_torch("auto")


def test_a_gpu_is_used_only_where_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    from edge_server.fields.ngp import torch_field

    monkeypatch.setattr(torch_field, "cuda_present", lambda: True)
    assert type(make_field("ngp", {"log2_table": 9})) is NgpField
    monkeypatch.setattr(torch_field, "cuda_present", lambda: False)
    with pytest.raises(ValueError, match="torch finds none"):
        make_field("ngp", {"log2_table": 9, "device": "cuda"})


@pytest.mark.parametrize(
    "option", [{"exposure": True}, {"refine_m": 0.03}, {"near_fade": 0.3}, {"depth_guide": 0.1}]
)
def test_a_gpu_refuses_what_only_the_kernels_do(option: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(option))} needs device cpu"):
        make_field("ngp", {"log2_table": 9, "device": "cuda", **option})
