"""Measures the live emulator from outside: cameras, emulator and sink are separate processes on loopback.

Two errors are reported, both counted from the instant at which a frame was due. ``delay_error_ms``, the
emulator's own error, ends when the frame is handed to gRPC. ``arrival_error_ms``, the error that a receiver
sees, ends when the sink's handler has the frame: it adds gRPC at both ends and the sink's scheduling.
``floor_ms`` is how late this machine wakes a process that only sleeps, at the emulator's priority and during
the same seconds; no emulator on it can be better. ``stolen`` is the share of processor time that a hypervisor
took away.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import grpc
import grpc.aio
import numpy as np

from channel_emu.live.priority import raise_priority
from channel_emu.live.upstream import PUSH
from channel_emu.model import trace
from freshfield.clock import WallClock
from freshfield.files import format_table
from freshfield.frame import parse
from freshfield.machine_load import cpu_s, machine_ticks, rss_mb
from freshfield.transport import Transport
from freshfield.v1 import frames_pb2 as pb

# No frame waits or is dropped, so that the counts show whether any was lost.
_CHANNEL = {"service": {"law": "exponential", "mean_ms": 60.0}, "discipline": "parallel"}
_DRAIN_S = 10.0
_START_S = 20.0


def bench(
    cameras: int, rate_hz: float, frame_bytes: int, seconds: float, load: int = 0, priority: bool = True
) -> dict[str, Any]:
    """Drive ``cameras`` streams at ``rate_hz`` for ``seconds`` through a real emulator to a real sink.

    frame_bytes: payload of each frame.
    load: number of processes that compute on the same cores meanwhile.
    priority: whether the emulator asks for a higher priority.
    Returns plain values; the module describes the errors. Raises ValueError for values out of range,
    RuntimeError if a process does not start or finish.
    """
    if not (1 <= cameras <= 1000 and rate_hz > 0 and seconds > 0 and 0 <= frame_bytes <= 8_000_000):
        raise ValueError("bench: expected 1 to 1000 cameras, rate and seconds above 0, at most 8 MB a frame")
    spawn = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        out = Path(folder)
        here, there = spawn.Pipe()
        sink = spawn.Process(target=_sink, args=(there, out / "arrivals.npy"), daemon=True)
        sink.start()
        stack.callback(sink.kill)
        if not here.poll(_START_S):
            raise RuntimeError("bench: the sink did not start")
        address = f"127.0.0.1:{_free_port()}"
        emulator = stack.enter_context(_emulator(out, cameras, address, f"127.0.0.1:{here.recv()}", priority))
        for _ in range(load):
            burner = spawn.Process(target=_burn, daemon=True)
            burner.start()
            stack.callback(burner.kill)
        floor_pipe, floor_end = spawn.Pipe()
        probe = spawn.Process(target=_probe, args=(floor_end, priority, seconds), daemon=True)
        source_pipe, source_end = spawn.Pipe()
        source = spawn.Process(
            target=_source, args=(source_end, address, cameras, rate_hz, frame_bytes, seconds), daemon=True
        )
        ticks = machine_ticks()
        source.start()
        probe.start()
        stack.callback(source.kill)
        stack.callback(probe.kill)
        if not source_pipe.poll(seconds + _START_S + 10):
            raise RuntimeError("bench: the cameras did not finish; is the emulator still running?")
        sent = source_pipe.recv()
        arrived = _drain(here, sent["sent"])
        spent = [b - a for a, b in zip(ticks or (), machine_ticks() or ())]
        used_s, resident_mb = cpu_s(emulator.pid), rss_mb(emulator.pid)
        emulator.send_signal(signal.SIGTERM)
        emulator.wait(10)
        here.send("stop")
        sink.join(10)
        status = json.loads((out / "channel.json").read_text())
        late = _arrival_errors(out)
        floor = floor_pipe.recv() if floor_pipe.poll(_START_S) else []
    return {
        "cameras": cameras,
        "rate_hz": rate_hz,
        "frame_bytes": frame_bytes,
        "seconds": round(sent["seconds"], 3),
        "load": load,
        "priority": status["priority"],
        "sent": sent["sent"],
        "not_sent": sent["behind"],
        "arrived": arrived,
        "lost": sent["sent"] - arrived,
        "broken": status["counts"]["broken"],
        "messages_per_s": round(sent["sent"] / sent["seconds"], 1),
        "megabytes_per_s": round(sent["sent"] * frame_bytes / sent["seconds"] / 1e6, 2),
        "delay_error_ms": status["delay_error_ms"],
        "arrival_error_ms": _percentiles(late),
        "answer_ms": _percentiles(np.array(sent["answer_ms"])),
        "floor_ms": _percentiles(np.array(floor)),
        "stolen": round(spent[-1] / sum(spent), 4) if sum(spent) else None,
        "emulator_cpu": None if used_s is None else round(used_s / sent["seconds"], 3),
        "emulator_rss_mb": resident_mb,
    }


def show(result: dict[str, Any]) -> str:
    """The result of ``bench`` as text, with the histogram of the delay error."""
    late = [
        {
            "ms": name.removesuffix("_ms").replace("_", " "),
            **{k: "-" if figures[k] is None else figures[k] for k in ("p50", "p95", "p99", "max")},
        }
        for name, figures in result.items()
        if isinstance(figures, dict)
    ]
    plain = [{"what": name, "value": value} for name, value in result.items() if not isinstance(value, dict)]
    shape = result["delay_error_ms"]["histogram"]
    most = max(shape["counts"], default=0)
    edges = shape["edges_ms"]
    bins = [
        f"{low:7.3f} - {high:7.3f}  {round(count):7d}  {'#' * round(50 * count / most)}"
        for low, high, count in zip(edges, edges[1:], shape["counts"])
    ]
    return "\n".join([format_table(plain), "", format_table(late), "", "delay error, histogram (ms)", *bins])


@contextlib.contextmanager
def _emulator(out: Path, cameras: int, listen: str, to: str, priority: bool) -> Iterator[subprocess.Popen[bytes]]:
    scenario = out / "bench.yaml"
    scenario.write_text(json.dumps({"name": "bench", "cameras": {"count": cameras}, "channel": _CHANNEL}))
    words = [sys.executable, "-m", "channel_emu.cli", "run", str(scenario), "--listen", listen, "--to", to]
    words += ["--out", str(out), "--trace", str(out / "trace.jsonl")]
    words += [] if priority else ["--no-priority"]
    with (out / "log.txt").open("wb") as log, subprocess.Popen(words, stderr=log) as process:
        try:
            deadline = time.perf_counter() + _START_S
            while not _connected(out / "channel.json"):
                if process.poll() is not None or time.perf_counter() > deadline:
                    raise RuntimeError(f"bench: the emulator did not start: {(out / 'log.txt').read_text()}")
                time.sleep(0.05)
            yield process
        finally:
            process.kill()


def _connected(status: Path) -> bool:
    with contextlib.suppress(OSError, ValueError):
        return all(c["connected"] for c in json.loads(status.read_text())["by_camera"].values())
    return False


def _sink(pipe: Connection, file: Path) -> None:
    asyncio.run(_serve_sink(pipe, file))


async def _serve_sink(pipe: Connection, file: Path) -> None:
    arrivals: list[tuple[int, int, int]] = []
    clock = WallClock()

    async def push(_: Any, context: grpc.aio.ServicerContext) -> None:
        while (raw := await context.read()) is not grpc.aio.EOF:
            now_ns = clock.now_ns()
            header = parse(raw).header
            arrivals.append((int(header.camera_id[3:]), header.sequence, now_ns))
            answer = pb.PushResponse(sequence=header.sequence, outcome=pb.OUTCOME_ACCEPTED)
            await context.write(answer.SerializeToString())

    server = Transport().aio_server()
    handler = grpc.method_handlers_generic_handler(
        "freshfield.v1.FrameStreamService", {"Push": grpc.stream_stream_rpc_method_handler(push)}
    )
    server.add_generic_rpc_handlers((handler,))
    port = Transport().bind(server, "127.0.0.1:0")
    await server.start()
    pipe.send(port)
    while True:
        word = await asyncio.to_thread(pipe.recv)
        if word == "stop":
            break
        pipe.send(len(arrivals))
    np.save(file, np.array(arrivals, np.int64).reshape(-1, 3))
    await server.stop(None)


def _source(pipe: Connection, address: str, cameras: int, rate_hz: float, frame_bytes: int, seconds: float) -> None:
    pipe.send(asyncio.run(_send_all(address, cameras, rate_hz, frame_bytes, seconds)))


async def _send_all(address: str, cameras: int, rate_hz: float, frame_bytes: int, seconds: float) -> dict[str, Any]:
    channel = Transport().aio_channel(address)
    await channel.channel_ready()
    totals: dict[str, Any] = {"sent": 0, "behind": 0, "answer_ms": []}
    payload = np.random.default_rng(0).bytes(frame_bytes)
    begun = time.perf_counter()
    await asyncio.gather(
        *(
            _camera(channel, number, begun + number / cameras / rate_hz, rate_hz, seconds, payload, totals)
            for number in range(cameras)
        )
    )
    totals["seconds"] = time.perf_counter() - begun
    await channel.close()
    return totals


async def _camera(
    channel: grpc.aio.Channel,
    number: int,
    first_s: float,
    rate_hz: float,
    seconds: float,
    payload: bytes,
    totals: dict[str, Any],
) -> None:
    """Send as one camera: a frame each period, at most one unanswered; it skips periods while it waits."""
    call = channel.stream_stream(PUSH)()
    clock = WallClock()
    frame = 0
    while frame < seconds * rate_hz:
        await asyncio.sleep(max(0.0, first_s + frame / rate_hz - time.perf_counter()))
        header = pb.FrameHeader(
            camera_id=f"cam{number:02d}",
            session_id="bench",
            sequence=frame,
            generated_ns=clock.now_ns(),
            role=pb.ROLE_TRAIN,
            codec=pb.CODEC_JPEG,
            width=1,
            height=1,
        )
        begun = time.perf_counter()
        await call.write(pb.PushRequest(header=header, payload=payload).SerializeToString())
        await call.read()
        totals["answer_ms"].append((time.perf_counter() - begun) * 1e3)
        totals["sent"] += 1
        now = int((time.perf_counter() - first_s) * rate_hz)
        totals["behind"] += max(0, now - frame - 1)
        frame = max(frame + 1, now)
    await call.done_writing()


def _probe(pipe: Connection, priority: bool, seconds: float) -> None:
    """Send how late, in ms, a process that only sleeps wakes at each instant of a 2 ms grid. A pause of the
    machine counts for every instant within it, as it would for messages."""
    if priority:
        raise_priority()
    late = []
    begun_ns = time.perf_counter_ns()
    for tick in range(1, int(seconds * 500)):
        due_ns = begun_ns + tick * 2_000_000
        time.sleep(max(0, due_ns - time.perf_counter_ns()) / 1e9)
        late.append((time.perf_counter_ns() - due_ns) / 1e6)
    pipe.send(late)


def _burn() -> None:
    a = np.random.default_rng(0).random((200, 200))
    while os.getppid() != 1:
        a = a @ a
        a /= np.abs(a).max()


def _drain(pipe: Connection, sent: int) -> int:
    deadline = time.perf_counter() + _DRAIN_S
    while True:
        pipe.send("count")
        arrived = int(pipe.recv())
        if arrived >= sent or time.perf_counter() > deadline:
            return arrived
        time.sleep(0.1)


def _arrival_errors(out: Path) -> np.ndarray:
    """Lateness in ms of each frame at the sink; the emulator's trace says when it was due."""
    (ledger,) = out.glob("ledger-emulator-*.tsv")
    origin_ns = int(ledger.stem.rsplit("-", 1)[1])
    due = {(int(r.camera[3:]), r.sequence): r.due_ns for r in trace.read(out / "trace.jsonl").records}
    arrivals = np.load(out / "arrivals.npy")
    late = [
        at - origin_ns - due_ns
        for camera, sequence, at in arrivals.tolist()
        if (due_ns := due.get((camera, sequence))) is not None
    ]
    return np.array(late) / 1e6


def _percentiles(values: np.ndarray) -> dict[str, float | None]:
    if not len(values):
        return dict.fromkeys(("p50", "p95", "p99", "max"))
    found = np.percentile(values, [50, 95, 99, 100])
    return {name: round(float(v), 4) for name, v in zip(("p50", "p95", "p99", "max"), found)}


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
