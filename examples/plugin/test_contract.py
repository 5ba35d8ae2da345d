"""The classes of this package keep freshfield's contracts. They are found by name once the package is installed.

pip install -e . && python -m pytest
"""

from importlib.metadata import entry_points

import pytest

from freshfield_up.cli import main

KINDS = ("policy", "effect", "fault", "field", "selector", "source")
OWN = [
    (kind, entry.name)
    for kind in KINDS
    for entry in entry_points(group=f"freshfield.{kind}")
    if entry.module == "freshfield_example"
]


def test_all_are_installed():
    assert OWN == [("policy", "least-used"), ("effect", "vignette"), ("source", "bar")]


@pytest.mark.parametrize(("kind", "name"), OWN)
def test_it_keeps_its_contract(kind, name, capsys):
    assert main(["check-plugin", kind, name]) == 0, capsys.readouterr().out
