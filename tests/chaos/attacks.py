"""Attacks on a live edge and emulator, while a well-behaved neighbor pushes frames to both.

    PYTHONPATH=.:deploy python -m tests.chaos.attacks --json docs/results/attacks.json

The first row is no attack. Each one goes on for SECONDS from a process of its own. It gives the time from
sending to the refusal (passing 8 MB is part of it), the neighbor's time from frame to answer meanwhile, and
the memory of the attacked process before, at most, and at most SETTLE_S after. Files are read by the
attacker's process.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import multiprocessing
import os
import socket
import sys
import tempfile
import threading
import time
import zipfile
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import grpc
import grpc.aio
import numpy as np

from camera_node.sources.datasets import transforms, zju
from edge_server.fields import checkpoint
from edge_server.foreground import ForegroundConfig
from edge_server.foreground.foreground import make_foreground
from freshfield import files, machine_load
from freshfield import scenario as scenarios
from freshfield.frame import checksum, to_request
from freshfield.geometry import Pinhole
from freshfield.limits import MAX_PAYLOAD_BYTES, MAX_SCRAPES, MAX_STREAMS_PER_CAMERA, MAX_WATCHERS
from freshfield.session.reader import Session
from freshfield.transport import Transport
from freshfield.untrusted import stored_bytes
from freshfield.v1 import edge_pb2, frames_pb2_grpc
from freshfield.v1 import frames_pb2 as pb
from freshfield_up.commands import process_set
from freshfield_up.net import free_ports, is_serving
from freshfield_up.processes import kill
from freshfield_up.status import read_json
from tests.camera_node.sources.datasets.photos import write_photos
from tests.camera_node.sources.datasets.test_formats import CRAFTED, write_object
from tests.camera_node.sources.datasets.test_transforms import edit
from tests.edge_server.foreground.pictures import save_endless_loop, save_memory_bomb
from tests.edge_server.frames import frame
from tests.freshfield.test_payload import JPEG, PROGRESSIVE, SCAN
from tests.freshfield.test_session import BOMBS
from tests.freshfield.test_untrusted import LISTS
from tests.waiting import wait_until

SECONDS, SETTLE_S, READY_S = 5.0, 10.0, 400.0
SCENARIO = """
name: attacked
seed: 3
cameras: {count: 5, held_out: [cam04]}
source: {kind: world, scene: tile, width: 64, height: 48, fps: 20}
channel:
  discipline: fcfs
  service: {law: deterministic, mean_ms: 40.0}
  faults: {corruption: {probability: 0.01}}
edge: {field: ngp, update_ms: 50, lpips: none}
"""
NEIGHBORS = {"edge": ("cam00", 0.02), "emulator": ("cam01", 0.05)}  # camera, seconds between frames
MINE = {"edge": "cam02", "emulator": "cam03"}
MOST_STREAMS = MAX_STREAMS_PER_CAMERA * 5
PUSH, EDGE = "/freshfield.v1.FrameStreamService/Push", "/freshfield.v1.EdgeService/"
Run = Callable[[dict[str, str]], Awaitable[tuple[list[float], str]]]
"""Of addresses; gives milliseconds until each refusal, and the answers."""


async def repeat(make: Callable[[], Any], once: Callable[[Any], Awaitable[str]]) -> tuple[list[float], str]:
    """For SECONDS: send what ``make`` gives; ``once`` returns the answer."""
    times, answers, over_s = [], Counter[str](), time.monotonic() + SECONDS
    while time.monotonic() < over_s:
        sent, begun_s = make(), time.perf_counter()
        answers[await once(sent)] += 1
        times.append((time.perf_counter() - begun_s) * 1e3)
    return times, ", ".join(f"`{answer}`" for answer, _ in answers.most_common(2))


def pushed(at: str, make: Callable[[], bytes]) -> Run:
    """Messages on one stream, each after the answer to the one before."""

    async def run(to: dict[str, str]) -> tuple[list[float], str]:
        async with Transport().aio_channel(to[at]) as channel:
            call = channel.stream_stream(PUSH)()

            async def once(raw: bytes) -> str:
                nonlocal call
                await call.write(raw)
                if (answer := await call.read()) is not grpc.aio.EOF:
                    said = pb.PushResponse.FromString(answer)
                    return said.reason or pb.Outcome.Name(said.outcome)
                ended, call = call, channel.stream_stream(PUSH)()
                return f"{(await ended.code()).name}, which ends the stream"

            return await repeat(make, once)

    return run


def called(method: str, request: Any) -> Run:
    async def run(to: dict[str, str]) -> tuple[list[float], str]:
        async with Transport().aio_channel(to["edge"]) as channel:

            async def once(raw: bytes) -> str:
                try:
                    await channel.unary_unary(EDGE + method)(raw)
                except grpc.aio.AioRpcError as error:
                    return error.code().name
                return "OK"

            return await repeat(request.SerializeToString, once)

    return run


def opened(at: str, method: str, count: int, most: int, *first: bytes) -> Run:
    """Streams at once, held for SECONDS; the time until all but ``most`` have ended."""

    async def run(to: dict[str, str]) -> tuple[list[float], str]:
        async with Transport().aio_channel(to[at]) as channel:
            begun_s, took_ms = time.monotonic(), []
            calls: list[Any] = [
                channel.unary_stream(method)(*first) if first else channel.stream_stream(method)() for _ in range(count)
            ]
            reading = [asyncio.create_task(read_to_the_end(call)) for call in calls]
            while time.monotonic() < begun_s + SECONDS:
                await asyncio.sleep(0.01)
                if not took_ms and sum(not task.done() for task in reading) <= most:
                    took_ms.append((time.monotonic() - begun_s) * 1e3)
            ended = [call for call, task in zip(calls, reading) if task.done()]
            for task in reading:
                task.cancel()
            codes = sorted({(await call.code()).name for call in ended})
            return took_ms, f"{len(ended)} of {count}: {', '.join(f'`{c}`' for c in codes)}"

    return run


async def read_to_the_end(call: Any) -> None:
    """gRPC gives a client the end of a call only after the answers before it."""
    with contextlib.suppress(grpc.aio.AioRpcError, asyncio.CancelledError):
        async for _ in call:
            pass


async def half_requests(to: dict[str, str]) -> tuple[list[float], str]:
    host, port = to["metrics"].split(":")
    held, begun_s = [], time.perf_counter()
    for _ in range(500):
        held.append(socket.create_connection((host, int(port)), timeout=SECONDS))
        held[-1].sendall(b"GET /metrics HTTP/1.1\r\n")
    for one in held[:-MAX_SCRAPES]:
        with contextlib.suppress(ConnectionError):
            assert one.recv(1) == b""
    took_ms = (time.perf_counter() - begun_s) * 1e3
    await asyncio.sleep(max(0.0, SECONDS - took_ms / 1e3))
    return [took_ms], f"all but {MAX_SCRAPES} closed"


def read(make: Callable[[Path], Callable[[], object]]) -> Run:
    """``make`` writes a file into a folder and returns what reads it, which must refuse."""

    async def run(_: Any) -> tuple[list[float], str]:
        with tempfile.TemporaryDirectory() as folder:

            async def once(reads: Callable[[], object]) -> str:
                try:
                    return f"read: {reads()}"
                except ValueError as error:  # of which every reader's error is one
                    return " ".join(str(error).replace(f"{folder}/", "").replace("|", "").split())[:90]

            reads = make(Path(folder))
            return await repeat(lambda: reads, once)

    return run


async def nothing(_: Any) -> tuple[list[float], str]:
    await asyncio.sleep(SECONDS)
    return [], ""


def good(**other: Any) -> bytes:
    """A good message of this instant, but for ``other``."""
    now_ns = time.time_ns()
    return to_request(frame(**{"sequence": now_ns, "generated_ns": now_ns, **other})).SerializeToString()


def jpeg(data: bytes) -> bytes:
    return good(camera=MINE["edge"], payload=data, intrinsics=Pinhole.from_fov(64, 48, 60.0))


def wrong_values() -> bytes:
    request = pb.PushRequest.FromString(good(camera=MINE["edge"]))
    request.header.codec, request.header.role = -1, -7  # type: ignore[assignment]
    request.crc32c = checksum(request.header, request.payload)
    return request.SerializeToString() if time.time_ns() % 2 else b"\xff\xff\xff"


def crafted_pickle(folder: Path) -> Callable[[], object]:
    write_object(folder / "annots.npy", CRAFTED["ndarray called"])
    return lambda: zju.load_dataset(folder)


def zip_bomb(folder: Path) -> Callable[[], object]:
    file, head = folder / "field.npz", {"descr": "|u1", "fortran_order": False, "shape": (2**30,)}
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as entry:
        np.lib.format.write_array_header_1_0(entry, head)
        for _ in range(2**10):
            entry.write(bytes(2**20))
    return lambda: checkpoint.load(file, most_bytes=stored_bytes(file))


def chunk_bomb(folder: Path) -> Callable[[], object]:
    (file := folder / "a.mcap").write_bytes(BOMBS["zstd"])

    def reads() -> None:
        raise ValueError(Session(file).cut)

    return reads


def yaml(text: str) -> Callable[[Path], Callable[[], object]]:
    def make(folder: Path) -> Callable[[], object]:
        (file := folder / "a.yaml").write_text(text)
        return lambda: scenarios.load(file)

    return make


def onnx(save: Callable[[Path], Path]) -> Callable[[Path], Callable[[], object]]:
    def make(folder: Path) -> Callable[[], object]:
        config = ForegroundConfig(detector=str(save(folder / "a.onnx")))
        return lambda: make_foreground(config)

    return make


def outside(leads: str) -> Callable[[Path], Callable[[], object]]:
    def make(folder: Path) -> Callable[[], object]:
        (inside := folder / "set").mkdir()
        file = edit(write_photos(inside, 2), lambda d: d["frames"][0].update(file_path=leads))
        return lambda: transforms.load_dataset(file)

    return make


_OURS, _FORMATS = "tests/freshfield/test_", "tests/camera_node/sources/datasets/test_"
_INGEST, _SERVER = (f"tests/edge_server/live/test_{of}.py::test_" for of in ("ingest", "server"))
_EMULATOR = "tests/channel_emu/live/test_frame_stream.py::test_"
_ONNX = "tests/edge_server/foreground/test_foreground.py::test_a_model_that_"
# What is sent, to whom (file: to its reader), what sends it, and the test that holds it.
ATTACKS: tuple[tuple[str, str, Run, str], ...] = (
    ("nothing", "edge", nothing, ""),
    (
        "`annots.npy` with a crafted pickle",
        "file",
        read(crafted_pickle),
        f"{_FORMATS}formats.py::test_a_crafted_pickle_is_refused",
    ),
    (
        "progressive JPEG of 40,000 scans",
        "edge",
        pushed("edge", lambda: jpeg(PROGRESSIVE[:-2] + 40_000 * SCAN + PROGRESSIVE[-2:])),
        f"{_OURS}payload.py::test_hostile_headers_are_refused_by_check_alone",
    ),
    (
        "JPEG with 8 MB of fill bytes",
        "edge",
        pushed("edge", lambda: jpeg(JPEG[:2] + b"\xff" * (MAX_PAYLOAD_BYTES - len(JPEG)) + JPEG[2:])),
        f"{_OURS}payload.py::test_eight_megabytes_that_keep_a_reader_busy",
    ),
    (
        "four million unknown protobuf fields",
        "emulator",
        pushed("emulator", lambda: good(camera=MINE["emulator"]) + b"\x78\0" * (4 * 2**20 - 1000)),
        f"{_OURS}frame.py::test_four_million_fields_are_read_at_once",
    ),
    (
        "`SetPolicy` with a name of 8 MB",
        "edge",
        called("SetPolicy", edge_pb2.SetPolicyRequest(name="n" * 8_000_000)),
        f"{_SERVER}a_name_of_eight_megabytes_is_no_policy",
    ),
    (
        "field number 0 under `corruption`",
        "emulator",
        pushed("emulator", lambda: good(camera=MINE["emulator"]) + b"\0\0"),
        f"{_EMULATOR}a_message_that_cannot_be_damaged_does_not_end_the_emulator",
    ),
    (
        "checkpoint that unpacks to 1 GB",
        "file",
        read(zip_bomb),
        "tests/edge_server/export/test_export_command.py::test_a_checkpoint_that_would_unpack_to_gigabytes_is_not_unpacked",
    ),
    (
        "MCAP chunk that unpacks to 256 MB",
        "file",
        read(chunk_bomb),
        f"{_OURS}session.py::test_a_chunk_bomb_is_left_out_and_said",
    ),
    ("YAML alias bomb", "file", read(yaml(LISTS)), f"{_OURS}untrusted.py::test_an_alias_bomb_is_refused_at_once"),
    (
        "YAML nested 20,000 deep",
        "file",
        read(yaml("a: " + "[a,\n" * 20_000)),
        f"{_OURS}untrusted.py::test_nesting_costs_no_more_than_its_bound",
    ),
    ("ONNX that loops 2^62 times", "file", read(onnx(save_endless_loop)), f"{_ONNX}loops_for_ever_is_refused"),
    (
        "ONNX tensor of 400 TB",
        "file",
        read(onnx(lambda file: save_memory_bomb(file, "Expand"))),
        f"{_ONNX}takes_terabytes_is_refused",
    ),
    (
        "`transforms` with `../`",
        "file",
        read(outside("../outside")),
        f"{_FORMATS}transforms.py::test_images_outside_the_data_set_are_not_read",
    ),
    (
        "`transforms` with an absolute path",
        "file",
        read(outside("/etc/hostname")),
        f"{_FORMATS}transforms.py::test_images_outside_the_data_set_are_not_read",
    ),
    (
        "30 silent streams",
        "edge",
        opened("edge", PUSH, 30, MOST_STREAMS),
        f"{_OURS}streams.py::test_silent_streams_shut_nobody_out",
    ),
    (
        "30 silent streams",
        "emulator",
        opened("emulator", PUSH, 30, MOST_STREAMS),
        f"{_EMULATOR}silent_streams_and_a_spoofed_session_do_not_keep_a_camera_out",
    ),
    (
        "2,000 watchers",
        "edge",
        opened("edge", f"{EDGE}WatchDecisions", 2000, MAX_WATCHERS, b""),
        f"{_SERVER}watchers_are_few_and_a_new_one_always_finds_a_place",
    ),
    (
        "snapshots in a loop",
        "edge",
        called("SaveSnapshot", edge_pb2.SaveSnapshotRequest()),
        f"{_SERVER}snapshots_do_not_fill_the_disk",
    ),
    (
        "500 half requests for metrics",
        "edge",
        half_requests,
        f"{_SERVER}metrics_hold_few_connections_and_answer_beside_half_requests",
    ),
    (
        "frames of 8 MB, faster than the link",
        "emulator",
        pushed("emulator", lambda: good(camera=MINE["emulator"], payload=bytes(MAX_PAYLOAD_BYTES))),
        f"{_EMULATOR}what_is_inside_the_links_is_bounded_in_bytes",
    ),
    (
        "`codec = -1`, `role = -7`, no message",
        "edge",
        pushed("edge", wrong_values),
        f"{_INGEST}a_refusal_is_named_counted_and_loses_nothing_else",
    ),
    (
        "made-up cameras",
        "edge",
        pushed("edge", lambda: good(camera=f"made-up-{time.time_ns()}")),
        f"{_INGEST}a_thousand_made_up_cameras_are_counted_as_one",
    ),
    (
        "ids with terminal commands",
        "edge",
        pushed("edge", lambda: good(camera=MINE["edge"], session="\x1b[2J\nERROR all is lost")),
        f"{_OURS}transport.py::test_what_a_peer_says_stays_on_one_line_of_a_log",
    ),
    (
        "the neighbor's session, spoofed",
        "edge",
        pushed("edge", lambda: good(camera=NEIGHBORS["edge"][0], session="neighbor", sequence=2**63)),
        f"{_INGEST}another_stream_cannot_use_up_the_numbers_of_a_session",
    ),
    (
        "a second node of the neighbor's camera",
        "edge",
        pushed("edge", lambda: good(camera=NEIGHBORS["edge"][0], session="another")),
        f"{_INGEST}two_nodes_of_one_name_are_told_apart_and_said",
    ),
)


class Neighbor(threading.Thread):
    """Pushes a frame each ``period_s``. answers: instant, milliseconds and outcome of each."""

    def __init__(self, address: str, camera: str, period_s: float) -> None:
        super().__init__(daemon=True)
        self.answers: list[tuple[float, float, str]] = []
        self._address, self._camera, self._period_s = address, camera, period_s
        self._answered, self._sent_s = threading.Semaphore(), 0.0

    def _frames(self) -> Iterator[pb.PushRequest]:
        while True:
            self._answered.acquire()
            time.sleep(self._period_s)
            now_ns = time.time_ns()
            request = to_request(frame(self._camera, now_ns, now_ns, session="neighbor"))
            self._sent_s = time.monotonic()
            yield request

    def run(self) -> None:
        with Transport().channel(self._address) as channel, contextlib.suppress(grpc.RpcError):
            for said in frames_pb2_grpc.FrameStreamServiceStub(channel).Push(self._frames()):
                now_s = time.monotonic()
                self.answers.append((now_s, (now_s - self._sent_s) * 1e3, said.reason or "accepted"))
                self._answered.release()

    def during(self, begun_s: float, over_s: float) -> dict[str, Any]:
        known = [(ms, what) for at_s, ms, what in self.answers if begun_s <= at_s <= over_s]
        others = Counter(what for _, what in known if what != "accepted")
        return {"frames": len(known), "ms": spread([ms for ms, _ in known]), "not_accepted": dict(others)}


def spread(values: list[float]) -> dict[str, float] | None:
    return {f"p{q}": round(float(np.percentile(values, q)), 1) for q in (50, 99)} if values else None


def rss_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/status").read_text().split("VmRSS:")[1].split()[0]) / 1e3


def call(number: int, to: dict[str, str]) -> tuple[list[float], str]:
    """In the attacker's process."""
    return asyncio.run(ATTACKS[number][2](to))  # type: ignore[arg-type]


def attacked(work: Path, only: str) -> dict[str, Any]:
    """What docs/results/attacks.json holds, of the attacks whose names contain ``only``."""
    (file := work / "attacked.yaml").write_text(SCENARIO)
    (out := work / "run").mkdir()
    page, metrics = free_ports(2)
    found = process_set(scenarios.load(file), out, page, edge_options=("--metrics-port", str(metrics)))
    to = {"edge": found.edge_address, "emulator": found.emulator_address, "metrics": f"127.0.0.1:{metrics}"}
    children = {"edge": found.edge, "emulator": found.emulator}
    neighbors = {who: Neighbor(to[who], *about) for who, about in NEIGHBORS.items()}
    rows, loads = [], []
    try:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as attacker:
            for child in children.values():
                child.start()
            wait_until(lambda: all(map(is_serving, (to["edge"], to["emulator"]))), "no start", READY_S)
            for each in neighbors.values():
                each.start()
            status = out / "edge.json"
            wait_until(
                lambda: ((read_json(status) or {}).get("updates") or {}).get("count", 0) > 20, "no updates", READY_S
            )
            for number, (sent, at, _, test) in enumerate(ATTACKS):
                if only not in sent:
                    continue
                if at == "file":  # imports
                    attacker.submit(call, number, to).result()
                child = children.get(at)
                pid = attacker.submit(os.getpid).result() if child is None else child.pid
                begun_s, memory_mb = time.monotonic(), [rss_mb(pid)]
                doing = attacker.submit(call, number, to)
                while not doing.done():
                    memory_mb.append(rss_mb(pid))
                    time.sleep(0.05)
                over_s, (times, answer) = time.monotonic(), doing.result()
                before_mb, most_mb = memory_mb[0], max(memory_mb)
                while (after_mb := rss_mb(pid)) > 1.02 * before_mb and time.monotonic() < over_s + SETTLE_S:
                    time.sleep(0.25)
                loads.append(os.getloadavg()[0])
                rows.append(
                    {
                        "sent": sent,
                        "at": at,
                        "test": test,
                        "answer": answer,
                        "times": len(times),
                        "refused_ms": spread(times),
                        "neighbors": {who: each.during(begun_s, over_s) for who, each in neighbors.items()},
                        "memory_mb": [round(mb) for mb in (before_mb, most_mb, after_mb)],
                    }
                )
                print(json.dumps(rows[-1]), flush=True)
            alive = {who: child.running for who, child in children.items()}
    finally:
        for child in children.values():
            kill(child)
    logs = b"".join((out / f"log-{who}.txt").read_bytes() for who in children)
    return {
        "cores": machine_load.usable_cores(),
        "load_average": round(float(np.median(loads)), 1),
        "seconds": SECONDS,
        "alive": alive,
        "escapes_in_logs": logs.count(b"\x1b"),
        "tracebacks_in_logs": logs.count(b"Traceback"),
        "attacks": rows,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result here")
    parser.add_argument("--only", default="", metavar="TEXT", help="attacks whose name contains this")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="freshfield-attacks-") as work:
        result = attacked(Path(work), args.only)
    if args.json:
        files.write_json(args.json, result, indent=1)
    print(json.dumps({key: value for key, value in result.items() if key != "attacks"}))
    held = all(result["alive"].values()) and not result["escapes_in_logs"] + result["tracebacks_in_logs"]
    refused = not any(row["answer"].startswith("read") for row in result["attacks"])
    heard = all(each["frames"] for row in result["attacks"] for each in row["neighbors"].values())
    return 0 if held and refused and heard else 1


if __name__ == "__main__":
    sys.exit(main())
