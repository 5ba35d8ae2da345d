"""The fixture ``channel``, which pytest finds where freshfield is installed (entry point ``pytest11``).

pytest imports this module at each start, so it imports nothing but pytest: gRPC and NumPy follow when a test first uses
the fixture. ``channel_emu.testing`` says how to use it.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest


@pytest.fixture
def channel(request: pytest.FixtureRequest) -> Iterator[Callable[..., Any]]:
    """Fixture that makes links in front of gRPC services: ``link = channel("ch5", to="localhost:50051")``.

    Arguments as of ``channel_emu.testing.EmulatedLink``. All links are closed at the end of the test.
    """
    from channel_emu.live.live_emulator_constants import SWITCH_INTERVAL_S

    emulated_link = importlib.import_module("channel_emu.testing").EmulatedLink  # which offers this fixture
    links: list[Any] = []

    def make(channel: Any, **options: Any) -> Any:
        links.append(emulated_link(channel, **options))
        return links[-1]

    before = sys.getswitchinterval()
    sys.setswitchinterval(min(before, SWITCH_INTERVAL_S))
    try:
        yield make
    finally:
        sys.setswitchinterval(before)
        with contextlib.ExitStack() as ending:
            for link in links:
                ending.callback(link.close)
        if links:
            # Shown by pytest if the test failed.
            text = "\n".join(link.describe() for link in links)
            request.node.add_report_section("teardown", "emulated channel", text)
