"""People are told when numba compiles, not when it loads; ``warm-up`` compiles what a scenario uses."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest
from numba.core import event

from edge_server.cli import main
from edge_server.fields import compiling
from edge_server.fields.compiling import LOG_EVERY_S, USUAL, Teller, told
from edge_server.fields.ngp.field import NgpField
from edge_server.fields.splat.layers.layered_field import LayeredField
from edge_server.fields.splat.scan.carried_field import CarriedField
from freshfield.scenario import load

KERNEL = """
from numba import njit

@njit(cache=True)
def doubled(x):
    return 2 * x
"""


def _kernel(path: Path) -> Any:
    """``doubled`` of a module that is imported anew."""
    spec = importlib.util.spec_from_file_location("kernels_of_a_test", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.doubled


def test_compiling_is_told_and_loading_is_not(tmp_path: Path) -> None:
    source = tmp_path / "kernels_of_a_test.py"
    source.write_text(KERNEL)
    lines: list[str] = []
    with told(lines.append):
        assert _kernel(source)(4) == 8
        assert _kernel(source)(4.0) == 8.0
        assert [line.split("): ")[1] for line in lines] == ["number 1 after 0 s", "number 2 after 0 s"]
        assert _kernel(source)(4) == 8
    assert len(lines) == 2, "the third was loaded from numba's cache"
    assert _kernel(source)(4j) == 8j
    assert len(lines) == 2, "nobody is told after the end of the block"


def test_kernels_that_are_compiled_later_are_counted_and_timed_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(compiling.time, "perf_counter", lambda: clock[0])
    lines: list[str] = []
    teller = Teller(lines.append, every_s=0.0)

    began = event.Event("numba:compile", event.EventStatus.START, {})
    for now_s, starts in ((1.0, True), (3.0, True), (11.0, False), (12.0, False), (300.0, True), (302.0, False)):
        clock[0] = now_s
        (teller.on_start if starts else teller.on_end)(began)
    assert [line.split("): ")[1] for line in lines] == [
        "number 1 after 0 s",
        "number 2 after 2 s",
        "number 1 after 0 s",
    ]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([], [(LayeredField, 1), (CarriedField, 1)]),
        (["--field", "ngp"], [(NgpField, 1)]),
        (["room"], [(LayeredField, len(load("room").training))]),
        (["handheld"], [(CarriedField, 1)]),
    ],
)
def test_warm_up_compiles_what_is_used(
    words: list[str], expected: list[tuple[type, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[tuple[type, int]] = []
    for kind in (LayeredField, CarriedField, NgpField):
        monkeypatch.setattr(kind, "warm_up", lambda field, cameras: found.append((type(field), cameras)) or 0.0)
    assert main(["warm-up", *words]) == 0
    assert found == expected


def test_a_log_gets_one_line_in_ten_seconds(tmp_path: Path) -> None:
    source = tmp_path / "kernels_of_a_test.py"
    source.write_text(KERNEL)
    lines: list[str] = []
    with event.install_listener("numba:compile", Teller(lines.append, LOG_EVERY_S)):
        _kernel(source)(1)
        _kernel(source)(1.0)
    assert len(lines) == 1 and USUAL in lines[0]
