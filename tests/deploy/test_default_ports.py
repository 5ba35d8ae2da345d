"""Default addresses meet, and examples name them: cameras -> emulator -> edge."""

from __future__ import annotations

import re

from tests.deploy.test_docs import help_of


def defaults(program: str) -> dict[str, str]:
    """{option: HOST:PORT} of every option of ``run`` whose help names a default address."""
    _, _, text = str(help_of(program, "run")).partition("options:")
    found = {}
    for entry in re.split(r"\n  (?=-)", text):
        address = re.search(r"[\w.]+:\d{2,5}\b", entry)
        if address:
            found[entry.split()[0]] = address.group()
    return found


def test_each_command_sends_to_where_the_next_one_listens() -> None:
    emulator, edge = defaults("channel-emu"), defaults("edge-server")
    assert emulator["--to"] == edge["--listen"] != emulator["--listen"]
    # A camera is always told where to send: its examples name the emulator.
    ports = re.findall(r"camera-node run .*--to \S*:(\d+)", str(help_of("camera-node", "run")))
    assert len(ports) >= 3 and {*ports} == {emulator["--listen"].rpartition(":")[2]}
