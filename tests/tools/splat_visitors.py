"""What visitors of the splat page cost and see, from a run that is going on.

    make demo SCENARIO=deploy/scenarios/room.yaml FOR=10m &
    python -m tests.tools.splat_visitors http://127.0.0.1:8080 --visitors 1 10 --pid PID

For each number of visitors, who read the stream and answer at once: bytes and messages a second for one of them, round
trip, Gaussians drawn, the edge server's cores (``--pid``, of its process). Then, unless ``--no-browser``, headless
Chromium: frames a second, and the milliseconds of JavaScript that a frame and a message take. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import websocket

from edge_server.page.splats.messages import KnotsBlock, MovingBlock, StaticBlock, StreamReader, read_message
from edge_server.page.splats.stream import STREAM
from tests.edge_server.page.browser import Browser

SETTLE_S = 5.0  # until the static set has come


class Reader(threading.Thread):
    """A visitor. by_kind: bytes by block, once ``counting``."""

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        self.reader, self.counting, self.messages, self.bytes = StreamReader(), False, 0, 0
        self.by_kind: dict[str, int] = {}
        self.lags_ms: list[float] = []
        self.done = False
        self._socket = websocket.create_connection(address, timeout=20)

    def run(self) -> None:
        while not self.done:
            data = self._socket.recv()
            self._socket.send(data[:4], websocket.ABNF.OPCODE_BINARY)
            self.reader.read(data)
            if self.counting:
                self.messages += 1
                self.bytes += len(data)
                for block in read_message(data)[2]:
                    size = {StaticBlock: 16, MovingBlock: 21}.get(type(block))
                    if size is not None:
                        self._add(type(block).__name__, size * len(block.records))  # type: ignore[union-attr]
                    elif isinstance(block, KnotsBlock):
                        self._add("KnotsBlock", 2 * block.displacements.size)
        self._socket.close()

    def _add(self, kind: str, size: int) -> None:
        self.by_kind[kind] = self.by_kind.get(kind, 0) + size


def cpu_s(pid: int | None) -> float:
    """Processor seconds of a process so far."""
    if pid is None:
        return float("nan")
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def visit(address: str, count: int, seconds: float, pid: int | None) -> dict[str, Any]:
    """``count`` visitors for so many seconds."""
    readers = [Reader(address) for _ in range(count)]
    for reader in readers:
        reader.start()
    time.sleep(SETTLE_S if count else 0.0)
    for reader in readers:
        reader.counting = True
    began, before = time.monotonic(), cpu_s(pid)
    time.sleep(seconds)
    took, cores = time.monotonic() - began, (cpu_s(pid) - before) / (time.monotonic() - began)
    for reader in readers:
        reader.done = True
    found: dict[str, Any] = {"visitors": count, "edge_cores": round(cores, 2)}
    if readers:
        link = readers[0].reader.status["link"]
        found |= {
            "kilobytes_per_s": round(float(np.median([r.bytes for r in readers])) / took / 1e3, 1),
            "messages_per_s": round(float(np.median([r.messages for r in readers])) / took, 1),
            "kilobytes_per_s_by_block": {k: round(v / took / 1e3, 1) for k, v in readers[0].by_kind.items()},
            "round_trip_ms": link["round_trip_ms"],
            "static": link["static"],
        }
    return found


def in_a_browser(url: str, width: int, height: int, seconds: float) -> dict[str, Any]:
    """Headless Chromium with software rendering, all pixels."""
    with Browser(f"{url}/splats/?full", width, height) as browser:
        browser.wait_for(lambda: browser.evaluate("window.splats && splats.reader.shown.total"), "Gaussians")
        time.sleep(SETTLE_S)
        browser.evaluate("for (const k of ['frames', 'draw', 'read']) splatStats[k].length = 0")
        time.sleep(seconds)
        stats = json.loads(browser.evaluate("JSON.stringify(splatStats)"))
    median = {name: round(float(np.median(stats[name])), 2) for name in ("draw", "read")}
    return {
        "pixels": [width, height],
        "frames_per_s": round(1e3 * len(stats["frames"]) / max(sum(stats["frames"]), 1e-9), 1),
        "ms_of_javascript_a_frame": median["draw"],
        "ms_of_javascript_a_message": median["read"],
        "gaussians": stats["drawn"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("url", help="of the live page")
    parser.add_argument("--visitors", type=int, nargs="+", default=[0, 1, 10], metavar="N")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--pid", type=int, help="of the edge server")
    parser.add_argument("--no-browser", action="store_true")
    args = parser.parse_args()
    address = args.url.replace("http", "ws", 1).rstrip("/") + STREAM
    found: dict[str, Any] = {"streams": [visit(address, n, args.seconds, args.pid) for n in args.visitors]}
    if not args.no_browser:
        sizes = ((800, 450), (1280, 720))
        found["browser"] = [in_a_browser(args.url.rstrip("/"), *size, args.seconds) for size in sizes]
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
