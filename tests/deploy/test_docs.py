"""The documentation: links resolve, commands and files exist."""

import difflib
import importlib
import importlib.util
import re
import shlex
from functools import cache
from pathlib import Path

import pytest

from tests.conftest import ROOT

_SPEC = importlib.util.spec_from_file_location("site_pages", ROOT / "docs" / "site_pages.py")
assert _SPEC is not None and _SPEC.loader is not None
site_pages = importlib.util.module_from_spec(_SPEC)  # a hook of mkdocs, in no package
_SPEC.loader.exec_module(site_pages)
help_of = cache(site_pages.help_of)
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").rglob("*.md")), ROOT / "deploy" / "lab" / "README.md"]
# Measured results, and what was tried and left, name commands and files as they were under a tag.
CURRENT = [page for page in PAGES if "results" not in page.parts and page.name != "tried-and-left.md"]
# What a paragraph, list item or row of a table says of the tag need not be there any more.
TAG = "v0.1-all"
# Folders of the repository that a page may name a path in.
TOP = ("camera_node", "channel_emu", "edge_server", "proto", "deploy", "docs", "examples", "tests")


def code_of(text: str) -> list[str]:
    """Code spans and lines of code blocks. A span may go over a line's end. Lines that name the tag are left out."""
    blocks = re.findall(r"(?:^|\n)(?:```\w*\n(.*?)\n```|((?: {4}[^\n]*\n)+))", text, re.S)
    lines = [line.strip() for pair in blocks for block in pair for line in block.splitlines()]
    return lines + [" ".join(span.split()) for span in re.findall(r"(?<!`)`([^`]+)`(?!`)", text)]


def of_today(page: Path) -> str:
    """A page without what it says of the tag."""
    parts = re.split(r"\n(?=\n|\||[-*] )", page.read_text())
    return "\n".join(part for part in parts if TAG not in part)


@pytest.mark.parametrize("page", PAGES)
def test_relative_links_resolve(page):
    """Anchors are checked by ``make docs``."""
    for link in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
        assert "://" in link or (page.parent / link).exists(), f"{page}: {link}"


def test_every_page_is_in_the_site_s_navigation_and_the_readme_is_short():
    words, lines = len(README.read_text().split()), len(README.read_text().splitlines())
    assert words <= 1200 and lines <= 160
    shown = (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2]
    for page in (ROOT / "docs").rglob("*.md"):
        path = page.relative_to(ROOT / "docs").as_posix()
        assert path.startswith("results/") or re.search(rf"[ ]{re.escape(path)}$", shown, re.M), path


def test_keys_bounds_and_defaults_of_scenarios_are_as_the_reference_says():
    told, known = site_pages.scenario_page().splitlines(), site_pages.SCENARIO_PAGE.read_text().splitlines()
    differs = "\n".join(difflib.unified_diff(known, told, "docs/reference/scenario.md", "the code", lineterm="", n=0))
    assert not differs, f"see CONTRIBUTING.md on defaults; 'make reference' writes it anew\n{differs}"


@pytest.mark.parametrize("page", CURRENT)
def test_commands_exist_with_the_options_they_are_given(page):
    for code in code_of(of_today(page)):
        called = rf"(?<!import )\b({'|'.join(site_pages.PROGRAMS)}) ([^|;&`]+)"
        for program, rest in re.findall(called, re.sub(r"\s#.*", "", code)):
            words = shlex.split(rest.replace("'", ""))
            if not words or not re.fullmatch(r"[a-z][a-z-]*", words[0]):
                continue  # a name in a sentence
            command = tuple(words[: 2 if words[0] in ("calibrate", "scenario") else 1])
            known = help_of(program, *command)
            assert known is not None, f"{page}: {program} {' '.join(command)}"
            given = {word.partition("=")[0] for word in words if re.match(r"--[a-z]", word)}
            assert given <= set(re.findall(r"--[a-z-]+", known)), f"{page}: {code}"


@pytest.mark.parametrize("page", CURRENT)
def test_files_and_modules_that_are_named_exist(page):
    for code in code_of(of_today(page)):
        for path in re.findall(rf"(?<![\w/.-])((?:{'|'.join(TOP)})/[\w./*@-]*)", code):
            test = re.search(rf"{re.escape(path)}::(\w+)", code)
            assert not test or f"def {test[1]}(" in (ROOT / path).read_text(), f"{page}: {code}"
            there = any(ROOT.glob(path.rstrip("./"))) or path.startswith("docs/results/")
            assert there, f"{page}: {path}"
        for module in re.findall(r"python -m ([\w.]+)|((?:camera_node|channel_emu|edge_server)\.[\w.]+)", code):
            found = (module[0] or module[1]).rstrip(".")
            parent, _, last = found.rpartition(".")
            assert not parent or importlib.util.find_spec(parent) is not None, f"{page}: {found}"
            assert importlib.util.find_spec(found) or hasattr(importlib.import_module(parent), last)


def test_each_command_sends_to_where_the_next_one_listens():
    texts = (" ".join(str(help_of(program, "run")).split()) for program in ("channel-emu", "edge-server"))
    emulator, edge = (dict(re.findall(r"(--listen|--to) HOST:PORT [^\[]*\[([\d.:]+)\]", text)) for text in texts)
    assert emulator["--to"] == edge["--listen"] != emulator["--listen"]
    # A camera is always told where to send: its examples name the emulator.
    ports = re.findall(r"camera-node run .*--to \S*:(\d+)", str(help_of("camera-node", "run")))
    assert len(ports) >= 3 and {*ports} == {emulator["--listen"].rpartition(":")[2]}
