"""The three commands, started without an address, find each other: cameras -> emulator -> edge."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest

import camera_node.cli
import channel_emu.cli
import edge_server.cli


def defaults(main: Callable[[list[str]], int], capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    """{option: HOST:PORT} of every option of ``run`` whose help names a default address."""
    with pytest.raises(SystemExit) as ended:
        main(["run", "--help"])
    assert ended.value.code == 0
    _, _, text = capsys.readouterr().out.partition("options:")
    found = {}
    for entry in re.split(r"\n  (?=-)", text):
        address = re.search(r"[\w.]+:\d{2,5}\b", entry)
        if address:
            found[entry.split()[0]] = address.group()
    return found


def test_each_command_sends_to_where_the_next_one_listens(capsys: pytest.CaptureFixture[str]) -> None:
    emulator = defaults(channel_emu.cli.main, capsys)
    edge = defaults(edge_server.cli.main, capsys)
    camera = defaults(camera_node.cli.main, capsys)
    assert emulator["--to"] == edge["--listen"]
    assert emulator["--listen"] != edge["--listen"]
    # A camera is told where to send; should it get a default, the emulator is the one to be there.
    assert camera.get("--to", emulator["--listen"]) == emulator["--listen"]
