"""``warm-up`` compiles what a scenario uses; what is compiled is kept for the state of the sources."""

from pathlib import Path

import numba
import pytest

from edge_server.cli import main
from edge_server.fields import compiling
from edge_server.fields.common.kernels.jit import cache_folder
from edge_server.fields.common.kernels.train import train_chunks
from edge_server.fields.ngp.field import NgpField
from edge_server.fields.splat.carried_camera.carried_field import CarriedField
from edge_server.fields.splat.layers.layered_field import LayeredField
from freshfield.scenario import load


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


def test_a_kernel_has_its_function_s_name_place_and_docstring() -> None:
    found = train_chunks.py_func
    assert (found.__module__, found.__qualname__) == ("edge_server.fields.common.kernels.train", "train_chunks")
    assert found.__doc__.startswith("Tasks are chunks.")


def test_compiled_kernels_are_kept_apart_for_every_state_of_the_sources(tmp_path, monkeypatch) -> None:
    """Or an edit to one file would leave yesterday's code running where it is inlined into another."""
    package = Path(compiling.__file__).parents[1]
    assert str(cache_folder(package)) == numba.config.CACHE_DIR and package.name == "edge_server"
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
    (source.parents[1] / "field_constants.py").write_text("NUMBER = 1")  # which kernels hold as a constant
    assert len({first, second, cache_folder(tmp_path)}) == 3
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    assert cache_folder(tmp_path).parent == tmp_path / "user" / "freshfield"
