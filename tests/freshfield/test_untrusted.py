"""Bombs of references: refused before anything of their size is made."""

import math
import os
import tracemalloc
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml

from freshfield import untrusted
from freshfield.limits import MAX_YAML_CHARS
from freshfield.untrusted import UntrustedError, read_bytes, read_json, read_text, read_yaml
from tests.support import refused, work_ms


def one_line(read, text: str) -> str:
    """Why a text is refused."""
    said = str(refused(UntrustedError, "", read, text))
    assert len(said) < 500
    return said


LEVELS = "abcdefghijklmnop"


def bomb(first: str, level: str) -> str:
    """Each level names the one before ten times."""
    lines = [f"a: &a {first}"]
    lines += [f"{b}: &{b} {level.format(', '.join([f'*{a}'] * 10))}" for a, b in pairwise(LEVELS)]
    return "\n".join(lines) + "\n"


LISTS = bomb("[x, x]", "[{}]")
MERGES = bomb("{k: v, l: w}", "{{<<: [{}]}}")


@pytest.mark.parametrize("text", [LISTS, MERGES, "&a [*a, *a]"], ids=["lists", "merges", "itself"])
def test_an_alias_bomb_is_refused_at_once(text):
    tracemalloc.start()
    refused(UntrustedError, "references expand to more than", read_yaml, text)
    assert tracemalloc.get_traced_memory()[1] < 2_000_000
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[" * 10_000, "nested too deeply"),
        ("a: [1", "not YAML"),
        ("a: " + "9" * 5000, "not YAML"),
        ("x" * (MAX_YAML_CHARS + 1), "characters, more than"),
        ("!!python/object/apply:os.system [true]", "could not determine a constructor"),
        ("a: 0x" + "f" * 5000, "not YAML"),  # a message could not quote it
        ("a: !!float 1" + ":00" * 300 + ":00.5", "not YAML"),
        ("a: 1\nb: 2\na: 3", "line 3: the key 'a' is there twice"),
        ("[{b: 1}, {b: 1, b: 1}]", "the key 'b' is there twice"),
        ("a: &a {b: 1}\nc: {<<: *a, <<: *a}", "line 2: the key '<<' is there twice"),
        (f"? {'k' * 10**4}\n? {'k' * 10**4}", "is there twice"),
        ("{? [1]: a}", "unhashable key"),
        ("? !x [1]\n: 2", "not YAML"),
        ("{1: a, 1.0: b}", "the key '1.0' is there twice"),
    ],
    ids=lambda v: v[:12],
)
def test_what_is_no_yaml_is_one_line(text, why):
    assert why in one_line(read_yaml, text)


def test_nesting_costs_no_more_than_its_bound():
    """The parser looks at every open bracket for each token."""
    text = "[a,\n" * 400 + "a,\n" * 40_000
    assert work_ms(lambda: one_line(read_yaml, text)) < 100


def test_honest_references_are_followed():
    text = "base: &b {width: 128, height: 96}\none: *b\ntwo: {<<: *b, width: 64}\n"
    assert read_yaml(text)["two"] == {"width": 64, "height": 96} and read_yaml(text)["one"]["width"] == 128
    assert read_yaml("") is None and read_yaml("3") == 3
    nested = "a: &a {x: 1}\nb: &b {<<: *a, x: 2}\nc: {<<: *b, x: 3}\n"
    assert read_yaml("{'1': a, 1: b, ~: c, None: d}") == {"1": "a", 1: "b", None: "c", "None": "d"}
    assert read_yaml(nested) == {"a": {"x": 1}, "b": {"x": 2}, "c": {"x": 3}}, "what is merged is no repetition"


def test_numbers_are_those_of_yaml_1_2():
    """In YAML 1.1, 1:30 is 90, 010 is 8, and 1e-3 a word."""
    found = read_yaml("[1:30, 1_000, 0, 0x1F, 0o17, -5, 1e-3, 2E6, .5, 5., 0.25, -.inf, on, 1-2]")
    assert found == ["1:30", 1000, 0, 31, 15, -5, 0.001, 2e6, 0.5, 5.0, 0.25, -math.inf, True, "1-2"]
    names = ["08", "010", "048322070531", "19443010E1234567", "01.5", "1__0"]
    assert read_yaml(f"[{', '.join(names)}]") == names
    assert math.isnan(read_yaml(".nan")) and read_yaml("!!int '12'") == 12
    words = ["08", "1e3", "1:30", "1_000", "0b11", "010", "7", "cam00", "0x1F", ".5"]
    kept = [*words, 8, 1e-5, 1e300, 0.1, True, None, math.inf]
    for read in (read_yaml, yaml.safe_load):
        assert read(yaml.dump(kept, Dumper=untrusted.YamlWriter)) == kept, "names stay words, numbers stay themselves"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ('{"a": 1, "b": {"c": 1, "d": 2, "c": 1}}', "the key 'c' is there twice"),
        ("[" * 10**5, "nested too deeply"),
        ("{", "Expecting"),
        ("9" * 5000, "limit"),
    ],
    ids=["twice", "deep", "cut", "long"],
)
def test_what_is_no_json_is_one_line(text, why):
    assert why in one_line(read_json, text)
    assert read_json('{"a": [{"a": 1}, {"a": 2}]}') == {"a": [{"a": 1}, {"a": 2}]}


def test_a_wide_value_takes_no_more_than_itself():
    """Lists in lists: what waits is counted, not only what was seen."""
    wide = [[0] * 1000] * 1000
    refused(UntrustedError, "", untrusted.refuse_expansion, wide, 5000, lambda v: v if isinstance(v, list) else ())
    untrusted.refuse_expansion(wide, 1_001_001, lambda v: v if isinstance(v, list) else ())


def test_an_uncompressed_archive_holds_no_more_than_its_size(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.zeros(1000))
    assert 8000 < untrusted.stored_bytes(tmp_path / "a.npz") < 9000 and untrusted.stored_bytes(tmp_path / "none") == 0
    assert work_ms(lambda: untrusted.stored_bytes(tmp_path / "a.npz")) < 5


def test_what_has_no_end_is_not_read(tmp_path):
    """A pipe would hang for ever, a device fill the memory."""
    os.mkfifo(tmp_path / "pipe")
    for read in (untrusted.check_file, read_bytes, read_text):
        for path in (Path("/dev/zero"), tmp_path / "pipe", tmp_path):
            refused(OSError, "a folder, a device or a pipe, not a file", read, path)


def test_a_file_is_read_up_to_its_bound(tmp_path):
    file = tmp_path / "file"
    file.write_bytes(b"a\r\nb" + bytes(2**20))
    assert read_bytes(file, 2**20 + 4) == file.read_bytes()
    assert read_text(file).startswith("a\nb")
    refused(OSError, "larger than 1 MB", read_bytes, file, 2**20)


@pytest.mark.parametrize(("read", "text"), [(read_yaml, r'{a: [x, "\ud800y"]}'), (read_json, r'["\ud800"]')])
def test_half_a_character_is_refused_where_it_is_read(read, text):
    """No log, report or message could hold it."""
    assert "is half of a character: no file can hold it" in one_line(read, text)
    assert read(r'["\ud83d\ude00"]' if read is read_json else '["\U0001f600"]') == ["\U0001f600"]
