"""The sample of edits is spread by lines, repeats for its seed, and goes to the tests beside each file."""

from __future__ import annotations

import pytest

pytest.importorskip("cosmic_ray", reason="the extra dev is not installed")

from tests import mutation_sample
from tests.mutation_sample import Edit, _shares, drawn, files, nearest_tests, places, room, share


def test_a_room_gets_edits_in_proportion_to_its_lines():
    assert _shares({"a": 50, "b": 30, "c": 20}, 10) == {"a": 5, "b": 3, "c": 2}
    assert _shares({"a": 7, "b": 2, "c": 1}, 4) == {"a": 3, "b": 1, "c": 0}
    assert room("edge_server/fields/ngp/field.py") == "edge_server/fields"
    assert room("edge_server/experiments/studies/run.py") == "edge_server/experiments/studies"


def test_an_edit_changes_one_line_of_what_is_computed(monkeypatch, tmp_path):
    code = (
        '"""Adds."""\n\n\ndef add(a: int | None, b: int) -> int:\n    if not a:\n        raise ValueError(f"{1 + 1}")\n'
    )
    (tmp_path / "some.py").write_text(code + "    print(2 + 2)\n    return a + b\n")
    monkeypatch.setattr(mutation_sample, "ROOT", tmp_path)
    texts = {edit.text() for edits in places("some.py").values() for edit in edits}
    assert texts == {
        "some.py:8: return a + b  ->  return a - b",
        "some.py:5: if not a:  ->  if  a:",
        "some.py:5: if not a:  ->  if not not a:",
    }


def test_a_seed_draws_one_sample(monkeypatch):
    few = [name for name in files() if "/model/link" in name or "/fidelity/psnr" in name]
    monkeypatch.setattr(mutation_sample, "files", lambda: few)
    first, again, other = drawn(1, 6), drawn(1, 6), drawn(2, 6)
    assert first == again != other and len(first) == 6
    assert {room(edit.file) for edit in first} == {"channel_emu/model", "edge_server/fidelity"}


@pytest.mark.parametrize(
    ("file", "first"),
    [
        ("edge_server/fidelity/psnr.py", "tests/edge_server/fidelity/test_psnr.py"),
        ("proto/freshfield/geometry.py", "tests/freshfield/test_geometry.py"),
    ],
)
def test_the_tests_of_a_file_are_beside_it(file, first):
    tests = nearest_tests(file)
    assert tests[0][0] == first and all(test.rpartition("/")[0] == first.rpartition("/")[0] for test in tests[1])


def test_the_share_has_an_interval():
    assert share(180, 200) == "180 of 200 caught: 90.0% [85.1%, 93.4%]"
    assert share(0, 0) == "nothing was run"


def test_a_copy_tells_what_is_caught_from_what_survives(tmp_path):
    edits = [e for edits in places("edge_server/fidelity/psnr.py").values() for e in edits]
    runner = mutation_sample.Runner(tmp_path)
    found = runner.outcome(next(e for e in edits if "10.0 *" in e.text() or "10 *" in e.text()))
    assert found == {"caught_by": ["tests/edge_server/fidelity/test_psnr.py"], "broken": []}
    assert (tmp_path / "edge_server/fidelity/psnr.py").read_text() == (
        mutation_sample.ROOT / "edge_server/fidelity/psnr.py"
    ).read_text()
    assert isinstance(edits[0], Edit)
