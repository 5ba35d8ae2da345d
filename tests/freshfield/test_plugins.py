"""Classes from outside: found by file, module or entry point; errors that say what is wrong; nothing loaded unasked."""

import sys
from importlib.metadata import EntryPoint

import pytest

from freshfield import plugins, scenario
from freshfield.plugins import PluginError, absolute, find, refuse_foreign, split_value
from tests.support import refused


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "loaded", 0, raising=False)
    (tmp_path / "mine.py").write_text("import sys\nsys.loaded += 1\nclass Mine:\n    pass\n")
    return tmp_path / "mine.py"


def test_names_and_values_as_people_type_them():
    assert split_value("all") == ("all", "") and split_value("threshold:120") == ("threshold", "120")
    assert split_value("a folder/mine.py:Mine:2.5") == ("a folder/mine.py:Mine", "2.5")
    assert split_value("package.module:Mine:7") == ("package.module:Mine", "7")
    assert plugins.is_reference("mine.py:Mine") and not plugins.is_reference("threshold")
    assert plugins.short_name("folder/mine.py:Mine") == "mine.py:Mine"


def test_a_module_and_an_entry_point(monkeypatch):
    assert find("policy", "fractions:Fraction", ()).__name__ == "Fraction"
    entry = EntryPoint("exact", "fractions:Fraction", "freshfield.policy")
    monkeypatch.setattr(plugins, "entry_points", lambda group: [entry] if group == "freshfield.policy" else [])
    assert find("policy", "exact", ()).__name__ == "Fraction"
    refused(PluginError, "effect 'exact' is not known", find, "effect", "exact", ["fog"])


@pytest.mark.parametrize(
    "name, message",
    [
        ("{file}:Yours", "no class Yours in it; there are: Mine"),
        ("no_such_package:Mine", "cannot be imported: ModuleNotFoundError"),
        ("{folder}/broken.py:Mine", "broken.py: cannot be imported: ZeroDivisionError"),
        ("threshhold", r"policy 'threshhold' is not known \(did you mean threshold\?\); there are: all, threshold"),
    ],
)
def test_what_cannot_be_used_is_said(file, name, message):
    (file.parent / "broken.py").write_text("1 / 0")
    for _ in range(2):  # the second time too: what failed is not kept
        refused(PluginError, message, find, "policy", name.format(file=file, folder=file.parent), ["all", "threshold"])


def test_a_file_beside_the_scenario_is_found_from_anywhere(file, monkeypatch):
    path = file.parent / "scenario.yaml"
    path.write_text(
        "cameras: {count: 2}\nedge: {policy: {name: 'mine.py:Mine'}}\nsource: {effects: {'mine.py:Mine': {a: 1}}}\n"
        "channel: {note: 'other.py:Mine'}\n"
    )
    monkeypatch.chdir("/")
    found = scenario.load(path)
    assert found.edge["policy"]["name"] == f"{file}:Mine"
    assert found.source["effects"] == {f"{file}:Mine": {"a": 1}}
    assert found.channel["note"] == "other.py:Mine"  # there is no such file
    assert absolute({"a": [1, None, "mine.py:Mine:3"]}, file.parent) == {"a": [1, None, f"{file}:Mine:3"]}
    assert sys.loaded == 0, "a file is executed only when its class is asked for, and once a process"
    name = found.edge["policy"]["name"]
    assert find("policy", name, ()) is find("policy", name, ()) and sys.loaded == 1


def test_files_of_others_name_nothing_that_is_loaded():
    refuse_foreign("field", "splat", "a checkpoint", allowed=False)
    refuse_foreign("field", "mine.py:Mine", "a checkpoint", allowed=True)
    with pytest.raises(PluginError, match=r"a checkpoint names the field mine.py:Mine.*--allow-plugins"):
        refuse_foreign("field", "mine.py:Mine", "a checkpoint", allowed=False)
