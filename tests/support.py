"""Free ports, small worlds, waits for other threads and processes, refusals and the work that one takes, turned
pictures."""

import asyncio
import importlib
import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

MOST_MS = 50.0
"""Of the work before a refusal: ingest answers every camera on one thread."""


def free_port() -> int:
    """A TCP port that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def small_world(**changed: Any) -> dict[str, Any]:
    """The source of a scenario: a room in small pictures."""
    size = {"kind": "world", "scene": "room", "width": 32, "height": 32, "fps": 15}
    return {**size, "params": {"supersample": 1}, **changed}


def wait_until(condition: Callable[[], Any], what: str | Callable[[], str], timeout_s: float = 20.0) -> Any:
    """The first true value of ``condition``. Fails with ``what`` if there is none within ``timeout_s``."""
    end = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < end, what if isinstance(what, str) else what()
        time.sleep(0.02)
    return value


def patiently(call: Callable[[], Any], error: type[Exception], timeout_s: float = 20.0) -> Any:
    """The first result of ``call``, which raises ``error`` before: a busy machine may be late."""

    def attempt() -> list[Any]:
        with suppress(error):
            return [call()]
        return []

    return wait_until(attempt, f"still {error.__name__}", timeout_s)[0]


async def until(condition: Callable[[], Any], timeout_s: float = 30.0) -> None:
    """Wait on the event loop until ``condition`` holds; TimeoutError if it does not."""
    async with asyncio.timeout(timeout_s):
        while not condition():
            await asyncio.sleep(0.01)


def alive(pid: int) -> bool:
    """Whether a process runs: one that has ended may wait for whoever adopted it to notice."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False


def refused(error: Any, message: str, call: Callable[..., Any], /, *args: Any, **options: Any) -> Any:
    """The ``error`` with which ``call`` refuses, in one line that matches ``message``."""
    with pytest.raises(error, match=message or None) as raised:
        call(*args, **options)
    assert "\n" not in str(raised.value)
    return raised.value


def refusal(capsys: pytest.CaptureFixture[str], main: Callable[[list[str]], int], *words: object) -> str:
    """The line with which a command refuses, with exit code 2."""
    assert main([str(word) for word in words]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def turned_jpeg(data: bytes, orientation: int) -> bytes:
    """A JPEG with an orientation in its Exif data."""
    tag = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0) + b"\0\0\0\0"
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(tag) + 2) + tag + data[2:]


def work_ms(call: Callable[[], Any]) -> float:
    """Milliseconds of this thread's processor time in ``call``: the least of seven, because others compute
    on the same cores."""
    times = []
    for _ in range(7):
        begun = time.thread_time()
        call()
        times.append((time.thread_time() - begun) * 1e3)
    return min(times)


def axes_drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Takes the axes of every figure that is saved from now on."""
    figure = importlib.import_module("matplotlib.figure").Figure
    kept, save = [], figure.savefig
    monkeypatch.setattr(figure, "savefig", lambda drawn, *a, **k: kept.append(drawn.axes) or save(drawn, *a, **k))
    return kept
