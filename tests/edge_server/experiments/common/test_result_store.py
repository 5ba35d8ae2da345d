"""The store of results: what is known is not computed again, and a stop or a torn file loses only what it
must."""

from __future__ import annotations

import json

from edge_server.experiments.common import result_store
from edge_server.experiments.common.result_store import ResultStore, content_key
from edge_server.experiments.common.tables import markdown_table, number
from freshfield.files import write_csv


def never():
    raise AssertionError("computed again")


def test_a_known_result_of_the_same_settings_is_not_computed_again():
    saved = []
    store = ResultStore({}, lambda path, result: saved.append((path, dict(result))))
    about = {"seconds": [1.0, 2.0], "processor": result_store.processor()}
    first = store.get("room", "ngp", compute=lambda: {"db": 20.0}, settings={"seconds": (1.0, 2.0)})
    assert store.results == {"room": {"ngp": {"db": 20.0, "settings": about}}}
    assert saved == [(("room", "ngp"), first)]
    again = ResultStore(json.loads(json.dumps(store.results)))
    assert again.get("room", "ngp", compute=never, settings={"seconds": (1.0, 2.0)}) == first
    other = again.get("room", "ngp", compute=lambda: {"db": 21.0}, settings={"seconds": (3.0,)})
    assert other["db"] == 21.0 and again.find("room", "ngp", settings={"seconds": (1.0, 2.0)}) is None
    assert again.find("room", "ngp", "deeper") is None and again.find("attic") is None


def test_lines_outlive_the_process_and_a_torn_last_one_counts_as_none(tmp_path):
    path = tmp_path / "made" / "results.jsonl"
    store = ResultStore.in_lines(path)
    for key, value in (("a", 1), ("b", 2), ("a", 3)):
        store.put(key, result={"value": value})
    store.close()
    path.write_text(path.read_text() + '{"key": "c", "val')
    again = ResultStore.in_lines(path)
    assert again.results == {"a": {"value": 3}, "b": {"value": 2}}
    again.put("d", result={"value": 4})
    again.close()
    assert set(ResultStore.in_lines(path).results) == {"a", "b", "d"}, "half a line swallowed the next one"


def test_a_content_key_is_of_the_content_and_not_of_its_order():
    assert content_key({"a": 1, "b": [2]}) == content_key({"b": [2], "a": 1}) != content_key({"a": 1, "b": [3]})
    assert len(content_key([], 40)) == 40


def test_results_of_another_kind_of_processor_are_not_taken_for_known(monkeypatch):
    store, settings = ResultStore(), {"steps": 3}
    key = content_key([settings])
    store.get("a", compute=dict, settings=settings)
    assert store.find("a", settings=settings) is not None
    monkeypatch.setattr(result_store, "processor", lambda: "x86_64 haswell")
    assert content_key([settings]) != key and store.find("a", settings=settings) is None


def test_tables_hold_every_row_and_what_is_missing_stays_empty(tmp_path):
    assert markdown_table(("a", "b"), [(1, None)]) == "| a | b |\n| --- | --- |\n| 1 |  |"
    assert number(None) == number(float("nan")) == "-" and number(1.0, 1, "+") == "+1.0"
    write_csv(tmp_path / "t.csv", [{"a": 1}, {"a": 2, "b": 3}])
    assert (tmp_path / "t.csv").read_text().split() == ["a,b", "1,", "2,3"]
