"""What a frame costs emulator and edge, by the number of cameras, and what follows for more of them.

    python -m tests.tools.scale --json docs/results/scale.json
    python -m tests.tools.scale --table docs/results/scale.json      # the table of docs/scale.md

Three processes: cameras, a live emulator with an ideal channel, the edge's ingest without a field. Each camera has a
stream with at most one unanswered frame; together they offer RATE frames a second. Counts processor seconds, which
other load changes less than rates. The rest is reckoned: see ``table``.
"""

import argparse
import asyncio
import json
import math
import multiprocessing
import os
import tempfile
from multiprocessing.connection import Connection
from pathlib import Path
from time import monotonic, process_time
from typing import Any

from freshfield.clock import WallClock
from freshfield.frame import to_request
from freshfield.limits import MAX_CAMERAS
from freshfield.machine_load import rss_mb
from freshfield.transport import Transport
from tests.channel_emu.live.emulator import Edge, make
from tests.edge_server.frames import frame
from tests.support import until

CAMERAS = (1, 10, 100, 1000)
RECKONED = (10, 100, 1000, 10_000)
FRAMES_PER_S = 15  # of a camera of the scenario `room`
FRAME_BYTES = 12_000  # of its pictures: 128 x 128, JPEG of quality 92
RATE = 200.0  # frames a second that are offered in all: a quarter of a core
_PUSH = "/freshfield.v1.FrameStreamService/Push"
_SPAWN = multiprocessing.get_context("spawn")


def names(count: int) -> tuple[str, ...]:
    return tuple(f"cam{k:04d}" for k in range(count))


async def _edge(count: int, out: Path, link: Connection) -> None:
    edge = Edge(out, names(count), (), Transport())
    await edge.start()
    await _answer(link, edge.port)
    await edge.stop()


async def _emulator(count: int, out: Path, port: int, link: Connection) -> None:
    proxy, flows = make(out, f"127.0.0.1:{port}", {}, names(count))
    await proxy.start()
    await until(lambda: all(flow.connected for flow in flows), 120.0)
    await _answer(link, proxy.port)
    await proxy.stop()


async def _answer(link: Connection, port: int) -> None:
    """Tell the port; then the processor seconds, each time they are asked for, until ``None`` comes."""
    link.send(port)
    while await asyncio.to_thread(link.recv) is not None:
        link.send((process_time(), rss_mb(os.getpid())))


def _process(role: Any, *args: Any) -> None:
    asyncio.run(role(*args))


class Part:
    """A process of its own."""

    def __init__(self, role: Any, *args: Any) -> None:
        self._link, theirs = _SPAWN.Pipe()
        self._process = _SPAWN.Process(target=_process, args=(role, *args, theirs))
        self._process.start()
        self.port: int = self._link.recv()

    def used(self) -> tuple[float, float]:
        """Processor seconds so far, and memory in MB."""
        self._link.send(True)
        return self._link.recv()

    def end(self) -> None:
        self._link.send(None)
        self._process.join(timeout=20)
        self._process.kill()


async def push(port: int, cameras: tuple[str, ...], seconds: float) -> int:
    """All cameras' frames on one connection; returns the number of answers."""
    channel, clock, answers = Transport().aio_channel(f"127.0.0.1:{port}"), WallClock(), 0

    async def camera(name: str, first_s: float) -> None:
        nonlocal answers
        call = channel.stream_stream(_PUSH)()
        due_s, sequence = monotonic() + first_s, 0
        while due_s < end_s:
            await asyncio.sleep(max(due_s - monotonic(), 0.0))
            await call.write(to_request(frame(name, sequence, clock.now_ns())).SerializeToString())
            await call.read()
            answers, sequence, due_s = answers + 1, sequence + 1, due_s + len(cameras) / RATE
        call.cancel()

    end_s = monotonic() + seconds
    await asyncio.gather(*(camera(name, k / RATE) for k, name in enumerate(cameras)))
    await channel.close()
    return answers


def measure(count: int, seconds: float) -> dict[str, Any]:
    """Processor milliseconds a frame, and memory, of emulator and edge with so many cameras."""
    with tempfile.TemporaryDirectory() as folder:
        edge = Part(_edge, count, Path(folder))
        emulator = Part(_emulator, count, Path(folder), edge.port)
        asyncio.run(push(emulator.port, names(count), 2.0 + count / RATE))  # connects, warms up
        before, began_s = (edge.used(), emulator.used()), monotonic()
        answers = asyncio.run(push(emulator.port, names(count), seconds + count / RATE))
        took_s, after = monotonic() - began_s, (edge.used(), emulator.used())
        for part in (emulator, edge):
            part.end()
    found: dict[str, Any] = {"cameras": count, "frames_per_s": round(answers / took_s, 1)}
    for name, (before_s, _), (after_s, memory) in zip(("edge", "emulator"), before, after):
        found |= {f"{name}_ms_a_frame": round(1e3 * (after_s - before_s) / answers, 2), f"{name}_mb": round(memory)}
    return found


def table(found: dict[str, Any]) -> str:
    """Markdown: what RECKONED cameras take, each with what a frame cost with the nearest number of cameras."""
    lines = ["| cameras | frames/s | MB/s | emulator, cores | ingest, cores | scenes |", "|---|---|---|---|---|---|"]
    for count in RECKONED:
        near = min(found["measured"], key=lambda row: abs(row["cameras"] - count))
        rate = FRAMES_PER_S * count
        emulator, edge = (rate * near[f"{name}_ms_a_frame"] / 1e3 for name in ("emulator", "edge"))
        scenes = max(math.ceil(count / MAX_CAMERAS), math.ceil(max(emulator, edge)))
        reckoned = f"{rate * FRAME_BYTES / 1e6:.1f} | {emulator:.1f} | {edge:.1f} | {scenes}"
        lines.append(f"| {count:,} | {rate:,} | {reckoned} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--cameras", type=int, nargs="+", default=CAMERAS)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--table", type=Path, help="print the table of such a file")
    args = parser.parse_args()
    if args.table is None:
        measured = [measure(count, args.seconds) for count in args.cameras]
        found = {"command": "python -m tests.tools.scale", "load_average": os.getloadavg()[0], "measured": measured}
        print(text := json.dumps(found, indent=1))
        if args.json is not None:
            args.json.write_text(text + "\n")
    else:
        print(table(json.loads(args.table.read_text())))


if __name__ == "__main__":
    main()
