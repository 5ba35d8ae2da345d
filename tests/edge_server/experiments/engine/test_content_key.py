"""Keys: every change that can change a result changes its key, and nothing else does."""

from __future__ import annotations

import importlib
import sys
from functools import partial
from pathlib import Path

import pytest

from edge_server.experiments.engine import content_key
from edge_server.experiments.engine.content_key import code_digest, content_digest, result_key
from edge_server.experiments.engine.engine import ResultStore
from edge_server.settings import ComputeConfig
from tests.edge_server.experiments.engine.jobs import Point, measure, note

CODE = '''
"""What it does."""
import json

def work(one):
    """Adds."""
    # a comment
    return one["a"] + 1
'''


def test_inputs_count_by_their_content_and_not_by_their_order():
    assert result_key(measure, {"a": 1, "b": [2]}) == result_key(measure, {"b": (2,), "a": 1})
    assert (
        len(
            {
                result_key(measure, x)
                for x in (1, 1.5, "1", [1], Point(1), Point(2), Point(1, scene="tower"), ComputeConfig(2.0))
            }
        )
        == 8
    )
    assert len(result_key(measure, 1)) == 40
    with pytest.raises(TypeError, match="no JSON value"):
        result_key(measure, object())


def test_the_function_counts_and_what_is_bound_to_it_does_not():
    bound = [result_key(partial(note, folder=Path(f)), Point(1)) for f in ("here", "there")]
    assert bound[0] == bound[1] == result_key(note, Point(1)) != result_key(measure, Point(1))


def test_the_kind_of_processor_and_the_versions_count(monkeypatch):
    key = result_key(measure, 1)
    monkeypatch.setattr(content_key, "processor", lambda: "x86_64 haswell")
    other = result_key(measure, 1)
    monkeypatch.setattr(content_key, "_versions", lambda: {"numpy": "1.0"})
    assert len({key, other, result_key(measure, 1)}) == 3


def test_files_count_by_their_contents_not_by_their_place_or_time(tmp_path):
    for name, text in (("a/x.txt", "one"), ("b/x.txt", "one"), ("c/y.txt", "one"), ("d/x.txt", "two")):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(text)
    a, b, c, d = (content_digest(tmp_path / name) for name in "abcd")
    assert a == b and len({a, c, d}) == 3
    keys = {result_key(measure, 1, files) for files in ([], [tmp_path / "a"], [None, tmp_path / "b"], [tmp_path / "d"])}
    assert len(keys) == 3
    (tmp_path / "a/x.txt").write_text("six")
    assert content_digest(tmp_path / "a") != a
    with pytest.raises(OSError):
        result_key(measure, 1, [tmp_path / "missing"])


@pytest.fixture
def digest(tmp_path, monkeypatch):
    """The digest of the code of a module with a text."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def of(text: str) -> str:
        (tmp_path / "some_work.py").write_text(text)
        importlib.invalidate_caches()
        sys.modules.pop("some_work", None)
        importlib.import_module("some_work")
        for cached in (content_key._source, content_key._facts, code_digest):
            cached.cache_clear()
        return code_digest("some_work")

    yield of
    sys.modules.pop("some_work", None)


def test_a_formatter_run_changes_nothing_and_an_operator_does(digest):
    before = digest(CODE)
    changed = CODE.replace('"a"', "'a'").replace("# a comment", "").replace("Adds.", "Sums up.").replace("    ", "  ")
    assert digest(changed) == before
    assert digest(CODE.replace("+ 1", "- 1")) != before
    assert digest(CODE + "\nfrom edge_server.fidelity import psnr\n") != before


def test_the_code_is_what_is_imported_by_name_or_through_a_registry():
    names = content_key._closure("edge_server.experiments.scenes.multiview_still")
    assert {"edge_server.fidelity.psnr", "freshfield.geometry", "camera_node.synthetic.scenes.room"} <= names
    assert not any(name.startswith(("edge_server.report", "edge_server.page")) for name in names)
    assert "edge_server.fields.splat.field" in content_key._closure("edge_server.fields.registry")


def test_lines_outlive_the_process_and_a_torn_last_one_counts_as_none(tmp_path):
    path = tmp_path / "made" / "results.jsonl"
    store = ResultStore(path)
    for key, value in (("a", 1), ("b", 2), ("a", 3)):
        store.put(key, {"seed": 1}, value)
    store.close()
    path.write_text(path.read_text() + '{"key": "c", "resu')
    again = ResultStore(path)
    assert again.results == {"a": 3, "b": 2}
    again.put("d", {}, 4)
    again.close()
    assert ResultStore(path).results == {"a": 3, "b": 2, "d": 4}, "half a line swallowed the next one"
