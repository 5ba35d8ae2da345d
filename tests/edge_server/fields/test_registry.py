"""Fields by name: lazily imported, options checked."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from typing import Any

import pytest

from edge_server.fields import Budget
from edge_server.fields.ngp.field import NgpField
from edge_server.fields.registry import efforts_of, field_names, make_field, option_help, settings_of
from tests.edge_server.fields.small import CLASSES, every_field


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        ("ngp", {"levels": 3, "centre_m": [1, 2, 3]}, {"levels": 3, "centre_m": (1.0, 2.0, 3.0)}),
        # A number that YAML takes for text is one.
        ("ngp", {"rate": "1e-3", "radius_m": None, "device": "cpu"}, {"rate": 1e-3, "radius_m": None}),
        ("nerfacto", {"bins": 40, "appearance": 4}, {"bins": 40, "appearance": 4}),
        ("tensorf", {"density_rank": 16, "upsample": [10, 20]}, {"density_rank": 16, "upsample": (10, 20)}),
        ("splat", {"gaussians": 99, "start": 9}, {"gaussians": 99, "start": 9}),
    ],
)
def test_make_field_passes_options_and_seed(name: str, options: dict, expected: dict) -> None:
    field: Any = make_field(name, options, seed=5)
    assert type(field) is CLASSES[name] and field.settings.seed == 5
    assert {option: getattr(field.settings, option) for option in expected} == expected


# In every representation that has the option.
REFUSED_ANYWHERE: list[tuple[str, Any, str]] = [
    ("rays", "many", "a whole number"),
    ("gaussians", 100.5, "a whole number"),
    ("cells", 64.0, "a whole number"),
    ("nice", "x", "a whole number"),
    ("seed", True, "a whole number"),
    ("contracted", "yes", "true or false"),
    ("exposure", "no", "true or false"),
    ("rate_end", float("nan"), "a finite number"),
    ("epsilon", "small", "a number"),
    ("background", 3, "text"),
    ("centre_m", [1, 2], "a list of 3 numbers"),
    ("centre_m", 5, "a list of 3 numbers"),
    ("effort", ["high"], "a name"),
    ("effort", "heroic", "one of low, medium, high"),
    ("rate", -1.0, "in 0.0..10.0"),
    ("rate_net", -1.0, "in 0.0..10.0"),
    ("rate_color", -1.0, "in 0.0..10.0"),
    ("rate_end", 0.0, "in 0.0001..1.0"),
    ("rate_end", -0.1, "in 0.0001..1.0"),
    ("epsilon", 0.0, "in 1e-10..1000.0"),
    ("epsilon", -1.0, "in 1e-10..1000.0"),
    ("changed_share", 7.0, "in 0.0..1.0"),
    ("distortion", -5.0, "in 0.0..1000.0"),
    ("depth_guide", -1.0, "in 0.0..1000.0"),
    ("guide_steps", 0, "in 1..1073741824"),
    ("decay", -1.0, "in 0.0..1000.0"),
    ("smooth", -1.0, "in 0.0..1000.0"),
    ("levels_start", 0, "in 1..24"),
    ("batch_samples", 2049, "a multiple of 2048"),
    ("threads", 0, "in 1..1024"),
    ("nice", -1, "in 0..19"),
    ("seed", -1, "in 0..9223372036854775807"),
]


@pytest.mark.parametrize(
    ("name", "option", "value", "text"),
    [(name, *row) for name in field_names() for row in REFUSED_ANYWHERE if row[0] in ("effort", *option_help(name))],
)
def test_what_no_field_can_work_with_is_refused(name: str, option: str, value: Any, text: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"{name}: {option} must be {text}, not {value!r}")):
        make_field(name, {option: value})


@pytest.mark.parametrize(
    ("name", "options", "text"),
    [
        ("gaussians", {}, "there are: ngp"),
        ("ngp", {"levles": 3, "rats": 4}, r"no option levles, rats; it has: effort, levels, .*threads"),
        ("nerfacto", {"density_rank": 8}, r"no option density_rank; it has: effort, .*bins.*nice"),
        ("tensorf", {"levels": 3}, r"no option levels; it has: effort, density_rank, .*nice"),
        ("splat", {"rays": 4096}, r"no option rays; it has: effort, gaussians, .*layers"),
        ("ngp", {"levels": 99}, r"levels must be in 1..24, not 99"),
        ("nerfacto", {"bins": 4}, "bins must be in 8..1024, not 4"),
        ("nerfacto", {"proposal_cells": 30}, "proposal_cells must be a multiple of 4"),
        ("nerfacto", {"even": 1.5}, "even must be in 0.0..1.0"),
        ("nerfacto", {"appearance": 99}, "appearance must be in 0..16"),
        ("nerfacto", {"appearance": 4, "exposure": True}, "choose one"),
        ("nerfacto", {"device": "cuda"}, "CPUs only"),
        ("tensorf", {"density_rank": 4}, "density_rank must be in 8..64, not 4"),
        ("tensorf", {"color_rank": 12}, "multiple of 8"),
        ("tensorf", {"upsample": [20, 10]}, "rising"),
        ("tensorf", {"resolution": 2}, "resolution must be in 4..1024"),
        ("tensorf", {"device": "cuda"}, "CPUs only"),
        ("splat", {"gaussians": 0}, "gaussians must be in"),
        ("splat", {"harmonics": 2}, "1, 4, 9"),
        ("splat", {"device": "cuda"}, "CPUs only"),
        ("splat", {"background": "pink"}, "#80c0ff"),
        ("splat", {"radius_m": -1.0}, "positive"),
        ("splat", {"flatten": float("nan")}, "flatten"),
        # Only the kernels do these.
        ("ngp", {"device": "cuda", "exposure": True}, "exposure needs device cpu"),
        ("ngp", {"device": "cuda", "refine_m": 0.03}, "refine_m needs device cpu"),
        ("ngp", {"device": "cuda", "depth_guide": 0.1}, "depth_guide needs device cpu"),
    ],
)
def test_what_one_field_cannot_work_with_is_refused(name: str, options: dict, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        make_field(name, options)


@pytest.mark.parametrize("wrong", [{"seconds": float("nan")}, {"seconds": float("inf")}, {"steps": -1}, {}])
def test_a_budget_without_an_end_is_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match="a budget is"):
        Budget(**wrong)


@every_field
def test_efforts_are_ordered_and_can_be_overridden(name: str) -> None:
    low, medium, high = (settings_of(name, {"effort": effort}) for effort in efforts_of(name))
    assert medium == type(medium)() == settings_of(name)
    for found, preset in zip((low, medium, high), efforts_of(name).values()):
        assert found == replace(medium, **preset)
    for option in {"ngp": ("samples", "batch_samples"), "splat": ("gaussians",)}.get(name, ("samples",)):
        assert getattr(low, option) < getattr(medium, option) < getattr(high, option)
    assert settings_of(name, {"effort": "high", "threads": 33}) == replace(high, threads=33)


@every_field
def test_every_option_has_help(name: str) -> None:
    assert all(len(text) > 10 for text in option_help(name).values())


def test_the_registry_imports_no_representation_and_a_cpu_needs_no_torch() -> None:
    """``auto`` means the CPU."""
    code = """
import sys
from edge_server.fields.registry import make_field
assert not {"numba", "torch"} & set(sys.modules), "imported by the registry itself"
for device in ("cpu", "auto"):
    make_field("ngp", {"device": device})
    assert "torch" not in sys.modules, device
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_gpu_is_used_only_where_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    from edge_server.fields.ngp import torch_field

    monkeypatch.setattr(torch_field, "cuda_present", lambda: True)
    assert type(make_field("ngp", {"log2_table": 9})) is NgpField
    monkeypatch.setattr(torch_field, "cuda_present", lambda: False)
    with pytest.raises(ValueError, match="torch finds none"):
        make_field("ngp", {"log2_table": 9, "device": "cuda"})
