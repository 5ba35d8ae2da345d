"""Fields by name: lazily imported, options checked."""

from __future__ import annotations

import re
import subprocess
import sys
from typing import Any

import pytest
from msgspec.structs import replace

from edge_server.fields import Budget
from edge_server.fields.registry import make_field, option_help, settings_of
from tests.edge_server.fields.small import CLASSES, every_field


@pytest.mark.parametrize(
    ("name", "options", "expected"),
    [
        ("ngp", {"levels": 3, "center_m": [1, 2, 3]}, {"levels": 3, "center_m": (1.0, 2.0, 3.0)}),
        ("tensorf", {"radius_m": None, "resolution": 99}, {"radius_m": None, "resolution": 99}),
        ("splat", {"gaussians": 99, "start": 9}, {"gaussians": 99, "start": 9}),
    ],
)
def test_make_field_passes_options_and_seed(name: str, options: dict, expected: dict) -> None:
    field: Any = make_field(name, options, seed=5)
    assert type(field) is CLASSES[name] and field.settings.seed == 5
    assert {option: getattr(field.settings, option) for option in expected} == expected


# In every representation that has the option: a value, and what is said of it.
REFUSED: list[tuple[str, Any, str]] = [
    ("gaussians", 100.5, "a whole number, 1 to 1048576"),
    ("seed", True, "a whole number"),
    ("contracted", "yes", "true or false"),
    ("radius_m", float("nan"), "a number"),
    ("near_m", 0.0, "a number, more than 0"),
    ("background", "pink", "#80c0ff"),
    ("center_m", [1, 2], "a list of 3"),
    ("threads", 0, "1 to 1024"),
    ("rays", 0, "1 to 1048576"),
    ("samples", 7, "8 to"),
    ("batch_samples", 2049, "a multiple of 2048"),
    ("changed_share", 7.0, "0 to 1"),
    ("refine_m", 1.5, "0 to 1"),
    ("sh_degree", 2, "one of 0, 1"),
    ("levels", 99, "1 to 24"),
    ("appearance", 17, "0 to 16"),
    ("resolution", 2, "4 to 1024"),
    ("levles", 3, "no option levles; it has: "),
    ("rate_net", 0.1, "no option rate_net; it has: "),  # a tuned number, no option
]


@every_field
def test_what_a_field_cannot_work_with_is_refused_by_name(name: str) -> None:
    tried = 0
    for option, value, text in REFUSED:
        if option in option_help(name) or text.startswith("no option"):
            tried += 1
            with pytest.raises(ValueError, match=f"^{name}.*{re.escape(text)}") as refused:
                make_field(name, {option: value})
            assert option in str(refused.value)
    assert tried >= 12
    with pytest.raises(ValueError, match="there are: ngp, nerfacto, tensorf, splat"):
        make_field("gaussians")


@pytest.mark.parametrize("wrong", [{"seconds": float("nan")}, {"seconds": float("inf")}, {"steps": -1}, {}])
def test_a_budget_without_an_end_is_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match="a budget is"):
        Budget(**wrong)


@every_field
def test_options_are_at_most_twenty_with_help(name: str) -> None:
    known = option_help(name)
    assert len(known) <= 20 and all(len(text) > 10 for text in known.values())
    usual = settings_of(name)
    assert usual == type(usual)() and settings_of(name, {"threads": 33}) == replace(usual, threads=33)


def test_the_registry_imports_no_representation_and_no_field_needs_torch() -> None:
    code = """
import sys
from edge_server.fields.registry import field_names, make_field
assert not {"numba", "torch"} & set(sys.modules), "imported by the registry itself"
for name in field_names():
    make_field(name)
    assert "torch" not in sys.modules, name
"""
    subprocess.run([sys.executable, "-c", code], check=True)
