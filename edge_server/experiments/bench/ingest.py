"""Measures a real edge server that trains, with a real client: the time of answers and the growth of
memory."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from camera_node.synthetic import Scene, make_scene
from edge_server.experiments.bench.run import BenchError, BenchRun
from freshfield import payload
from freshfield.clock import WallClock
from freshfield.frame import Frame, to_request
from freshfield.geometry import Pose
from freshfield.machine_load import LoadMeter, cpu_s, rss_mb
from freshfield.transport import Transport
from freshfield.v1 import frames_pb2 as pb
from freshfield.v1 import frames_pb2_grpc

CAMERAS, SIZE = 18, 128
RATES = (15, 33)
TARGET_P99_MS = 20.0
_IMAGES = 8  # number of different frames of a camera, sent in turn
_START_S = 180.0  # longest start: compiling all kernels on a busy machine


def measure(run: BenchRun) -> dict[str, Any]:
    """Answers and memory at each frame rate, while the field trains all the time."""
    seconds = 8.0 if run.quick else 60.0
    scene = make_scene("room", {"count": CAMERAS, "width": SIZE, "height": SIZE})
    frames = _frames(scene)
    return {f"{fps}_fps": _at_rate(run.folder / str(fps), scene, frames, fps, seconds) for fps in RATES}


def _at_rate(out: Path, scene: Scene, frames: dict[str, list[bytes]], fps: float, seconds: float) -> dict[str, Any]:
    """Measure one server at one frame rate. Raises BenchError."""
    out.mkdir(parents=True)
    with _edge_server(out, list(frames), fps) as (process, address):
        return asyncio.run(_drive(process, address, out, scene, frames, fps, seconds))


@dataclass
class _Tally:
    """Counts over all cameras.

    counting: whether frames are counted now.
    answer_ms: milliseconds from sending a frame to its answer.
    missed: number of ticks at which the last frame had no answer yet (like a node, the client has at most one
        unacknowledged frame).
    refused: number of frames that were not accepted.
    """

    counting: bool = False
    answer_ms: list[float] = field(default_factory=list)
    missed: int = 0
    refused: int = 0


async def _drive(
    process: subprocess.Popen[bytes],
    address: str,
    out: Path,
    scene: Scene,
    frames: dict[str, list[bytes]],
    fps: float,
    seconds: float,
) -> dict[str, Any]:
    tally, load = _Tally(), LoadMeter("client")
    channel = Transport().aio_channel(address)
    cameras = [asyncio.ensure_future(_camera(channel, scene, c, frames[c], fps, tally)) for c in frames]
    try:
        await _until_training(process, out, cameras)
        load.row(0.0)
        begun, edge_begun = time.perf_counter(), cpu_s(process.pid)
        updates = _updates(out)
        tally.counting = True
        memory = []
        while (t_s := time.perf_counter() - begun) < seconds:
            memory.append((t_s, rss_mb(process.pid)))
            await asyncio.sleep(0.5)
        tally.counting = False
        outside, edge_ended = load.outside_cores(), cpu_s(process.pid)
        updates = _updates(out) - updates
    finally:
        for task in cameras:
            task.cancel()
        await asyncio.gather(*cameras, return_exceptions=True)
        await channel.close()
    edge = None if edge_begun is None or edge_ended is None else (edge_ended - edge_begun) / t_s
    p50, p99 = np.percentile(tally.answer_ms, [50, 99])
    return {
        "frames": len(tally.answer_ms),
        "frames_per_s": len(tally.answer_ms) / t_s,
        "answer_p50_ms": float(p50),
        "answer_p99_ms": float(p99),
        "answer_max_ms": max(tally.answer_ms),
        "missed": tally.missed,
        "refused": tally.refused,
        "updates": updates,
        **_growth(memory),
        "edge_cores": edge,
        "outside_cores": None if outside is None or edge is None else max(0.0, outside - edge),
    }


async def _camera(channel: Any, scene: Scene, camera: str, images: list[bytes], fps: float, tally: _Tally) -> None:
    """Push a frame per tick over one stream; a tick at which the last frame is unanswered is missed."""
    lens, matrix = scene.cameras[camera]
    pose, clock, session = Pose.from_matrix(matrix), WallClock(), f"bench-{os.getpid()}"
    outgoing: asyncio.Queue[pb.PushRequest] = asyncio.Queue()

    async def requests() -> AsyncIterator[pb.PushRequest]:
        while True:
            yield await outgoing.get()

    stream = frames_pb2_grpc.FrameStreamServiceStub(channel).Push(requests())
    loop = asyncio.get_running_loop()
    begun, tick, sequence = loop.time(), 0, 0
    while True:
        frame = Frame(camera, session, sequence, clock.now_ns(), pose, lens, "jpeg", images[sequence % len(images)])
        sent = time.perf_counter()
        outgoing.put_nowait(to_request(frame))
        answer = await stream.read()
        if tally.counting:
            tally.answer_ms.append((time.perf_counter() - sent) * 1e3)
            tally.refused += answer.outcome != pb.OUTCOME_ACCEPTED
        sequence += 1
        late = max(tick + 1, int((loop.time() - begun) * fps))
        tally.missed += (late - tick - 1) if tally.counting else 0
        tick = late
        await asyncio.sleep(begun + tick / fps - loop.time())


async def _until_training(process: subprocess.Popen[bytes], out: Path, cameras: list[Any]) -> None:
    """Wait until the field has published twice; from then on it trains without a break. Raises BenchError."""
    begun = time.perf_counter()
    while _updates(out) < 2:
        for task in cameras:
            if task.done():
                task.result()
        if process.poll() is not None or time.perf_counter() - begun > _START_S:
            raise BenchError(f"the edge server did not begin to train:\n{_last_words(out)}")
        await asyncio.sleep(0.25)


def _growth(memory: list[tuple[float, float | None]]) -> dict[str, Any]:
    """Resident memory of the edge at start and end, and its slope over the run."""
    known = [(t, m) for t, m in memory if m is not None]
    if len(known) < 2:
        return {"rss_start_mb": None, "rss_end_mb": None, "rss_mb_per_min": None}
    t, mb = np.array(known).T
    return {
        "rss_start_mb": float(mb[0]),
        "rss_end_mb": float(mb[-1]),
        "rss_mb_per_min": float(np.polyfit(t, mb, 1)[0] * 60.0),
    }


def _frames(scene: Scene) -> dict[str, list[bytes]]:
    times = [k * scene.period_s / _IMAGES for k in range(_IMAGES)]
    return {c: [payload.encode(scene.render(c, t)) for t in times] for c in scene.cameras}


@contextlib.contextmanager
def _edge_server(out: Path, cameras: list[str], fps: float) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """``edge-server run`` on a free port, ended with SIGINT and waited for."""
    scenario = out / "bench.yaml"
    scenario.write_text(
        yaml.safe_dump(
            {
                "name": "bench",
                "cameras": {"ids": cameras},
                "source": {"kind": "world", "scene": "room", "width": SIZE, "height": SIZE, "fps": fps},
                "edge": {"field": "ngp", "lpips": "none"},
            }
        )
    )
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    command = [sys.executable, "-m", "edge_server.cli", "run", str(scenario), "--listen", address, "--out", str(out)]
    with (out / "log.txt").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        try:
            _await_port(process, address, out)
            yield process, address
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(20.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _await_port(process: subprocess.Popen[bytes], address: str, out: Path) -> None:
    host, _, port = address.partition(":")
    begun = time.perf_counter()
    while time.perf_counter() - begun < _START_S:
        if process.poll() is not None:
            break
        with contextlib.suppress(OSError), socket.create_connection((host, int(port)), 1.0):
            return
        time.sleep(0.1)
    raise BenchError(f"the edge server does not listen on {address}:\n{_last_words(out)}")


def _updates(out: Path) -> int:
    try:
        return int(json.loads((out / "edge.json").read_text())["updates"]["count"])
    except (OSError, ValueError, KeyError):
        return 0


def _last_words(out: Path) -> str:
    return "\n".join((out / "log.txt").read_text(errors="replace").splitlines()[-8:])
