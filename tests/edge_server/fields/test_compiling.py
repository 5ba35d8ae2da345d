"""People are told when numba compiles, not when it loads; ``warm-up`` compiles what a scenario uses."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from edge_server.cli import main
from edge_server.fields.common.kernels.jit import cache_folder
from edge_server.fields.compiling import told
from edge_server.fields.ngp.field import NgpField
from edge_server.fields.splat.carried_camera.carried_field import CarriedField
from edge_server.fields.splat.layers.layered_field import LayeredField
from freshfield.scenario import load

KERNEL = """
from numba import njit

@njit(cache=True)
def doubled(x):
    return 2 * x
"""


def test_compiling_is_told_and_loading_is_not(tmp_path: Path) -> None:
    source = tmp_path / "kernels_of_a_test.py"
    source.write_text(KERNEL)
    lines: list[str] = []

    def doubled(x: complex) -> complex:
        """Of a module that is imported anew."""
        return runpy.run_path(str(source))["doubled"](x)

    with told(lines.append):
        assert doubled(4) == 8 and doubled(4.0) == 8.0
        assert [line.split("): ")[1] for line in lines] == ["number 1", "number 2"]
        assert doubled(4) == 8
    assert len(lines) == 2, "the third was loaded from numba's cache"
    assert doubled(4j) == 8j
    assert len(lines) == 2, "nobody is told after the end of the block"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], [(LayeredField, 1), (CarriedField, 1)]),
        (["--field", "ngp"], [(NgpField, 1)]),
        (["room"], [(LayeredField, len(load("room").training))]),
        (["handheld"], [(CarriedField, 1)]),
    ],
)
def test_warm_up_compiles_what_is_used(words: list[str], expected: list[tuple[type, int]], monkeypatch) -> None:
    found: list[tuple[type, int]] = []
    for kind in (LayeredField, CarriedField, NgpField):
        monkeypatch.setattr(kind, "warm_up", lambda field, cameras: found.append((type(field), cameras)) or 0.0)
    assert main(["warm-up", *words]) == 0
    assert found == expected


def test_compiled_kernels_are_kept_apart_for_every_state_of_the_sources(tmp_path, monkeypatch) -> None:
    """Or an edit to one file would leave yesterday's code running where it is inlined into another."""
    source, other = tmp_path / "fields" / "kernels" / "a.py", tmp_path / "fields" / "field.py"
    source.parent.mkdir(parents=True)
    source.write_text("x = 1")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    first = cache_folder(tmp_path)
    assert first.parent == tmp_path / "cache"
    other.write_text("y = 1")
    assert cache_folder(tmp_path) == first
    source.write_text("x = 2")
    second = cache_folder(tmp_path)
    (source.parents[1] / "settings.py").write_text("NUMBER = 1")  # which kernels hold as a constant
    assert len({first, second, cache_folder(tmp_path)}) == 3
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    assert cache_folder(tmp_path).parent == tmp_path / "user" / "freshfield"
