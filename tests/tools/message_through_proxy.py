"""Times a message through the live emulator, of one source tree or of several in turn.

    python -m tests.tools.message_through_proxy [TREE ...] [--frames 3000] [--bytes 20000]

Every tree's emulator runs as a process of its own on an ideal channel; one camera sends through all of them, a
frame at a time and in turn, so that other load meets them alike. Prints medians and 99th percentiles of the way to
the receiver and of the answer to the sender, the start until the emulator listens, and its memory.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import grpc
import grpc.aio
import numpy as np

from freshfield.files import format_table
from freshfield.frame import to_request
from freshfield.machine_load import rss_mb
from freshfield.transport import Transport
from freshfield.v1 import frames_pb2 as pb
from tests.channel_emu.live.emulator import frame_of
from tests.support import free_port

PUSH = "/freshfield.v1.FrameStreamService/Push"
_START_S = 60.0
_WARM_UP = 200


class Sink:
    """The edge's side: answers every frame, and notes when it came."""

    def __init__(self) -> None:
        self.arrived = asyncio.Event()
        self.at_ns = 0

    async def push(self, _: object, context: grpc.aio.ServicerContext) -> None:
        """Handle one stream of an emulator."""
        while (raw := await context.read()) is not grpc.aio.EOF:
            self.at_ns = time.perf_counter_ns()
            self.arrived.set()
            sequence = pb.PushRequest.FromString(raw).header.sequence
            answer = pb.PushResponse(sequence=sequence, outcome=pb.OUTCOME_ACCEPTED)
            await context.write(answer.SerializeToString())


class Through:
    """One tree's emulator, and what was measured of it."""

    def __init__(self, tree: Path, out: Path, sink: str) -> None:
        self.tree, self.port = tree, free_port()
        self.way_us: list[float] = []
        self.answer_us: list[float] = []
        scenario = out / "t.yaml"
        scenario.write_text(json.dumps({"name": "t", "cameras": {"count": 1}}))
        words = [sys.executable, "-m", "channel_emu.cli", "run", str(scenario), "--out", str(out / "run")]
        words += ["--listen", f"127.0.0.1:{self.port}", "--to", sink]
        paths = os.pathsep.join(str(tree / part) for part in ("proto", "."))
        self._began = time.perf_counter()
        self.process = subprocess.Popen(words, cwd=tree, env={**os.environ, "PYTHONPATH": paths})
        self.start_s = 0.0

    async def connect(self) -> None:
        """Wait until it listens, and open the camera's stream."""
        channel = Transport().aio_channel(f"127.0.0.1:{self.port}")
        async with asyncio.timeout(_START_S):
            await channel.channel_ready()
        self.start_s = time.perf_counter() - self._began
        self._call = channel.stream_stream(PUSH)()
        await self._call.wait_for_connection()

    async def send(self, sequence: int, raw: bytes, sink: Sink) -> None:
        """Pass one frame, and wait for its arrival and its answer."""
        sink.arrived.clear()
        began_ns = time.perf_counter_ns()
        await self._call.write(raw)
        await self._call.read()
        answered_ns = time.perf_counter_ns()
        await sink.arrived.wait()
        if sequence >= _WARM_UP:
            self.way_us.append((sink.at_ns - began_ns) / 1e3)
            self.answer_us.append((answered_ns - began_ns) / 1e3)


async def measure(trees: list[Path], frames: int, size: int) -> list[dict[str, object]]:
    """A row of figures for each tree. size: bytes of a frame's payload."""
    server, sink = Transport().aio_server(), Sink()
    handler = {"Push": grpc.stream_stream_rpc_method_handler(sink.push)}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(PUSH.split("/")[1], handler),))
    to = f"127.0.0.1:{Transport().bind(server, '127.0.0.1:0')}"
    await server.start()
    request = to_request(frame_of("cam00", "timing", 0, 0))
    request.payload = bytes(size)
    with contextlib.ExitStack() as ending:
        every = []
        for tree in trees:
            out = Path(ending.enter_context(tempfile.TemporaryDirectory()))
            every.append(Through(tree.resolve(), out, to))
            ending.callback(every[-1].process.kill)
            await every[-1].connect()
        for sequence in range(frames + _WARM_UP):
            request.header.sequence = sequence
            raw = request.SerializeToString()
            for each in every if sequence % 2 else reversed(every):
                await each.send(sequence, raw, sink)
        return [
            {
                "tree": str(each.tree),
                **{f"way p{p} (us)": float(np.percentile(each.way_us, p)) for p in (50, 99)},
                **{f"answer p{p} (us)": float(np.percentile(each.answer_us, p)) for p in (50, 99)},
                "start (s)": each.start_s,
                "memory (MB)": rss_mb(each.process.pid),
            }
            for each in every
        ]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("trees", nargs="*", type=Path, default=[Path(".")], help="source trees [.]")
    parser.add_argument("--frames", type=int, default=3000)
    parser.add_argument("--bytes", type=int, default=20_000)
    args = parser.parse_args()
    print(format_table(asyncio.run(measure(args.trees, args.frames, args.bytes))))


if __name__ == "__main__":
    main()
