"""Pages of the site that are made from the code: every command's --help, every key of a scenario, and files from
outside docs/.

A hook of mkdocs (``mkdocs.yml``); the site is built where freshfield is installed with the extra ``edge``. Run as a
program (``make reference``) it writes the page of keys, which is kept as a file: who changes a default or a bound sees
it there, and so does who reviews it.
"""

from __future__ import annotations

import contextlib
import io
import os
import posixpath
import re
from pathlib import Path
from typing import TYPE_CHECKING
from unittest import mock

from camera_node.cli import main as camera_node
from channel_emu.cli import main as channel_emu
from edge_server.cli import main as edge_server
from freshfield import plugins
from freshfield_up import scenario_keys
from freshfield_up.cli import main as freshfield

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

PROGRAMS = {
    "freshfield": freshfield,
    "camera-node": camera_node,
    "channel-emu": channel_emu,
    "edge-server": edge_server,
}
# Files of the repository that are pages of the site: file -> page.
OUTSIDE = {"deploy/lab/README.md": "lab.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
ROOT = Path(__file__).resolve().parent.parent
SCENARIO_PAGE = ROOT / "docs" / "reference" / "scenario.md"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages."""
    from mkdocs.structure.files import File  # the tests, which have no mkdocs, read the help from here

    made = {"reference/commands.md": commands_page()}
    made |= {page: (ROOT / file).read_text() for file, page in OUTSIDE.items()}
    for page, text in made.items():
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links between docs/ and the rest of the repository: to the page of a file, else its name alone."""
    origin = {made: file for file, made in OUTSIDE.items()}.get(page.file.src_uri, f"docs/{page.file.src_uri}")

    def relinked(found: re.Match[str]) -> str:
        path, _, anchor = found["link"].partition("#")
        target = posixpath.normpath(posixpath.join(posixpath.dirname(origin), path))
        inside = OUTSIDE.get(target, target.removeprefix("docs/") if target.startswith("docs/") else None)
        if inside is None:
            return found["text"]
        link = posixpath.relpath(inside, posixpath.dirname(page.file.src_uri) or ".")
        return f"[{found['text']}]({link}{'#' if anchor else ''}{anchor})"

    return re.sub(r"(?<!!)\[(?P<text>[^\]]*)\]\((?P<link>(?!\w+:|#)[^)\s]+)\)", relinked, markdown)


def help_of(program: str, *words: str) -> str | None:
    """What ``program words --help`` prints; None where there is no such command."""
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()):
        try:
            PROGRAMS[program]([*words, "--help"])
        except SystemExit as end:
            return None if end.code else out.getvalue()
    return out.getvalue()


def commands_page() -> str:
    """The help of every command, and of the commands below it."""
    os.environ["COLUMNS"] = "100"  # argparse's width of a line
    parts = ["# Commands\n\nEvery command prints this with `--help`.\n"]
    for program in PROGRAMS:
        waiting: list[tuple[str, ...]] = [()]
        while waiting:
            words = waiting.pop(0)
            text = help_of(program, *words)
            if text is None:
                raise ValueError(f"{program} {' '.join(words)}: is listed, but prints no help")
            parts.append(f"{'##' if not words else '###'} {' '.join((program, *words))}\n\n```text\n{text}```\n")
            listed = re.search(r"^  (?:COMMAND|WHAT)\n(.*?)\n\n", text, re.M | re.S)
            names = re.findall(r"^    ([a-z][a-z-]+)(?= |$)", listed[1], re.M) if listed else []
            waiting += [(*words, name) for name in names]
    return "\n".join(parts)


def scenario_page() -> str:
    """Keys, bounds, units and defaults of a scenario's sections, as the settings that read it have them."""
    parts = [
        "# Scenario keys\n\nWhat each section of a scenario file may say. `freshfield scenario keys SECTION` prints "
        "the same, and `freshfield scenario schema` the JSON Schema for editors. `make reference` writes this page.\n"
    ]
    with mock.patch.object(plugins, "installed", lambda kind: []):  # only what is built in
        texts = {section: scenario_keys.text(section) for section in scenario_keys.SECTIONS}
    for section, text in texts.items():
        parts.append(f"\n## {section}\n")
        table = begun = False
        for line in text.splitlines():
            key = re.match(r" {4}(\S+) +(.*)", line)
            if key:
                if not table:
                    parts.append("\n| key | default, allowed, meaning |\n|---|---|")
                about = key[2].replace("|", "\\|").replace("*", "\\*")
                parts.append(f"| `{key[1]}` | {about} |")
            elif line and not line.startswith(" "):
                title = f"`{line}`" if "{" in line or "." in line else line
                heading = f"\n### {title}\n" if begun or line != section else ""
                parts.append(f"\n{line}\n" if "; " in line else heading)
            else:
                words = line.strip()
                told = re.match(r"[\w, ]+: ", words) and parts[-1].endswith((".", ")"))  # a docstring, of a key
                parts.append(("\n" if told else "") + re.sub(r"^([+*-]) ", r"\\\1 ", words))
            table = key is not None
            begun = begun or table
    return re.sub(r"\n{3,}", "\n\n", "\n".join([*parts, ""])).replace("``", "`")


if __name__ == "__main__":
    SCENARIO_PAGE.write_text(scenario_page())
