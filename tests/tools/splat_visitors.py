"""What visitors of the splat page cost and see, from a run that is going on.

    freshfield demo room --for 10m --port 8080 &
    python -m tests.tools.splat_visitors http://127.0.0.1:8080 --visitors 0 1 10 --through ideal good bad --pid PID

``--visitors``: so many who read the stream and answer at once, and as many whose pictures the edge renders (the live
page): bytes and messages a second, round trip, Gaussians drawn, the edge server's cores (``--pid``, of its process).
``--through``: one visitor behind ``channel-emu proxy --tcp`` beside one without it, whose picture at the same instants
theirs is compared with. ``--browser``: headless Chromium, frames a second and JavaScript, in turn with viser's own
renderer of the same Gaussians. Prints one JSON object.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import websocket
from numpy.typing import NDArray

from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.splat.kernels.project import Gaussians
from edge_server.fields.splat.snapshot import SplatSnapshot
from edge_server.page.settings import NETWORKS
from edge_server.page.splats.messages import KnotsBlock, MovingBlock, StaticBlock, StreamReader, read_message
from edge_server.page.splats.stream import STREAM
from freshfield.geometry import Pinhole, look_at
from tests.edge_server.fields.scenes import psnr
from tests.edge_server.page.visitor import Visitor
from tests.support import free_port
from tests.tools.splat_browser import frames_of_the_page, frames_of_viser

SETTLE_S = 5.0  # until the static set has come
PICTURES_EVERY_S = 0.5
SIZE = (400, 225)  # of the pictures that are compared
MOVES = 0.05  # difference of color with and without the moving set, from which a pixel moves
FLOATS_BYTES = 68  # of a Gaussian in a PLY file: what a whole snapshot takes without records


class Reader(threading.Thread):
    """A visitor of the stream. by_block: bytes by kind of block, blocks: their number, once ``counting``."""

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        self.reader, self.counting, self.messages, self.bytes = StreamReader(), False, 0, 0
        self.by_block: Counter[str] = Counter()
        self.blocks: Counter[str] = Counter()
        self.moving: list[int] = []  # Gaussians of each moving set
        self.ahead_s = -np.inf  # the edge's present minus this machine's clock
        self.lock = threading.Lock()
        self.done = False
        self._socket = websocket.create_connection(address, timeout=60)

    def run(self) -> None:
        while not self.done:
            try:
                data = self._socket.recv()
            except websocket.WebSocketConnectionClosedException:
                if self.done:  # the proxy before it has ended
                    return
                raise
            with self.lock:
                self.reader.read(data)
            self._socket.send(data[:4], websocket.ABNF.OPCODE_BINARY)
            _, instant_s, blocks = read_message(data)
            self.ahead_s = max(self.ahead_s, instant_s - time.monotonic())
            if self.counting:
                self.messages += 1
                self.bytes += len(data)
                for block in blocks:
                    self._count(block)
        self._socket.close()

    def _count(self, block: object) -> None:
        if isinstance(block, MovingBlock):
            size = 21 * len(block.records)
            self.moving.append(len(block.records))
        elif isinstance(block, StaticBlock):
            size = 16 * len(block.records)
        elif isinstance(block, KnotsBlock):
            size = 2 * block.displacements.size
        else:
            return
        self.by_block[type(block).__name__] += size
        self.blocks[type(block).__name__] += 1

    def found(self, took_s: float) -> dict[str, Any]:
        """What came in so many seconds."""
        link = self.reader.status["link"]
        return {
            "kilobytes_per_s": round(self.bytes / took_s / 1e3, 1),
            "messages_per_s": round(self.messages / took_s, 1),
            "kilobytes_per_s_by_block": {k: round(v / took_s / 1e3, 1) for k, v in sorted(self.by_block.items())},
            "blocks_per_s": {k: round(v / took_s, 1) for k, v in sorted(self.blocks.items())},
            "round_trip_ms": link["round_trip_ms"],
            "static_of": link["static"],
            "moving": round(float(np.mean(self.moving))) if self.moving else 0,
        }

    def at(self, instant_s: float) -> NDArray[np.float32]:
        """A copy of the Gaussians to draw at an instant of the edge."""
        with self.lock:
            return self.reader.at(instant_s).copy()


@contextlib.contextmanager
def reading(*addresses: str) -> Iterator[list[Reader]]:
    """Visitors who have read for SETTLE_S, and are counted from now on."""
    readers = [Reader(address) for address in addresses]
    for reader in readers:
        reader.start()
    time.sleep(SETTLE_S if readers else 0.0)
    for reader in readers:
        reader.counting = True
    try:
        yield readers
    finally:
        for reader in readers:
            reader.done = True


class Cores:
    """Cores that a process uses from now on; NaN without one."""

    def __init__(self, pid: int | None) -> None:
        self._pid, self.began_s = pid, time.monotonic()
        self._before_s = self._cpu_s()

    def _cpu_s(self) -> float:
        if self._pid is None:
            return float("nan")
        fields = Path(f"/proc/{self._pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def found(self) -> tuple[float, float]:
        """Seconds that have passed, and the cores."""
        took_s = time.monotonic() - self.began_s
        return took_s, round((self._cpu_s() - self._before_s) / took_s, 2)


def visit(address: str, count: int, seconds: float, pid: int | None) -> dict[str, Any]:
    """``count`` visitors of the stream for so many seconds; figures of the first one."""
    with reading(*[address] * count) as readers:
        cores = Cores(pid)
        time.sleep(seconds)
        took_s, used = cores.found()
        found = readers[0].found(took_s) if readers else {}
        if readers:
            drawn = len(readers[0].at(np.inf))
            whole = drawn * found["blocks_per_s"].get("KnotsBlock", 0.0) / 1e3
            sizes = {"records": 16, "ply": FLOATS_BYTES}
            found["kilobytes_per_s_of_whole_snapshots"] = {k: round(v * whole) for k, v in sizes.items()}
    return {"visitors": count, "edge_cores": used} | found


def visit_rendered(port: int, count: int, seconds: float, pid: int | None) -> dict[str, Any]:
    """As ``visit``, of the live page: the edge renders a picture of 800 x 450 for each."""
    visitors = [Visitor(port, (3.0, 2.0 + 0.1 * k, 2.0), size=(800, 450)) for k in range(count)]
    time.sleep(SETTLE_S)
    before, cores = [(v.images, v.bytes) for v in visitors], Cores(pid)
    time.sleep(seconds)
    took_s, used = cores.found()
    images, sizes = np.mean([(v.images - i, v.bytes - b) for v, (i, b) in zip(visitors, before)], axis=0)
    for visitor in visitors:
        visitor.close()
    rates = {"pictures_per_s": round(images / took_s, 1), "kilobytes_per_s": round(sizes / took_s / 1e3, 1)}
    return {"visitors": count, "edge_cores": used} | rates


# --- a bad last mile -------------------------------------------------------------------------------


@contextlib.contextmanager
def last_mile(name: str, to: str, seed: int) -> Iterator[int]:
    """The port of the emulator's TCP proxy before ``to``, on conditions that the live page calls so."""
    delay_ms, loss = NETWORKS[name]
    port = free_port()
    words = [sys.executable, "-m", "channel_emu.cli", "proxy", "--tcp", "--direction", "both", "--seed", str(seed)]
    words += ["--to", to, "--listen", f"127.0.0.1:{port}"]
    words += ["--service", f"exp:{delay_ms:g}ms", "--fault", f"loss:{loss:g}"] if delay_ms else []
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield port
    finally:
        process.terminate()
        process.wait(timeout=20)


def through(name: str, host: str, seconds: float, seed: int) -> dict[str, Any]:
    """A visitor behind the proxy beside one without it. seed: of the proxy's delays and losses."""
    with last_mile(name, host, seed) as port:
        time.sleep(2.0 * SETTLE_S)  # Python starts, numpy is imported
        with reading(f"ws://{host}{STREAM}", f"ws://127.0.0.1:{port}{STREAM}") as (near, far):
            began_s, pairs = time.monotonic(), []
            while time.monotonic() < began_s + seconds:
                time.sleep(PICTURES_EVERY_S)
                present_s = time.monotonic() + near.ahead_s
                pairs.append((near.at(present_s), far.at(present_s), len(near.reader._shown.params)))
            found = far.found(time.monotonic() - began_s)
        compared = [compare(near.reader, *pair) for pair in pairs if len(pair[1])]
    median = [round(float(np.nanmedian(values)), 1) for values in zip(*compared)]
    return (
        {"last_mile": name, "seed": seed, "mean_delay_ms": NETWORKS[name][0], "loss": NETWORKS[name][1]}
        | found
        | dict(zip(("db", "db_where_it_moves"), median))
    )


def compare(reader: StreamReader, wanted: NDArray, got: NDArray, still: int) -> tuple[float, float]:
    """dB between two pictures from where visitors begin: in all, and where what moves is. still: rows of ``wanted``
    that stand still."""
    one, two, without = (render(reader, params) for params in (wanted, got, wanted[:still]))
    moves = np.abs(one - without).max(axis=-1) > MOVES
    return psnr(one, two), psnr(one[moves], two[moves]) if moves.any() else float("nan")


def render(reader: StreamReader, params: NDArray[np.float32]) -> NDArray[np.float32]:
    """What the edge would render of these Gaussians, (H, W, 3)."""
    scene, start = reader.scene, reader.status["start"]
    assert scene is not None
    box = SceneBox(scene.center_m, scene.radius_m, scene.near * scene.radius_m, True, scene.radius_m, 0.01)
    lens = Pinhole.from_fov(*SIZE, np.degrees(2.0 * np.arctan(np.tan(0.5 * start["fov"]) * SIZE[0] / SIZE[1])))
    shown = SplatSnapshot(box, Gaussians(params, 0), np.array(scene.background, np.float32), CallerPool(), 0)
    pose = look_at(start["position"], start["look_at"])
    return np.clip(shown.render(pose, lens).color, 0.0, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("url", help="of the live page")
    parser.add_argument("--visitors", type=int, nargs="+", default=[], metavar="N")
    parser.add_argument("--through", nargs="+", default=[], choices=("ideal", "good", "bad"))
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="runs of each last mile")
    parser.add_argument("--browser", action="store_true")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--pid", type=int, help="of the edge server")
    args = parser.parse_args()
    host = args.url.partition("://")[2].rstrip("/")
    words = " ".join(["python -m tests.tools.splat_visitors", *sys.argv[1:]])
    found: dict[str, Any] = {"command": words, "load_average": os.getloadavg()[0]}
    if args.visitors:
        port = int(host.rpartition(":")[2])
        found["streams"] = [visit(f"ws://{host}{STREAM}", n, args.seconds, args.pid) for n in args.visitors]
        found["rendered"] = [visit_rendered(port, n, args.seconds, args.pid) for n in args.visitors if n]
    if args.through:
        found["through"] = [through(name, host, args.seconds, n) for name in args.through for n in range(args.seeds)]
    if args.browser:
        with reading(f"ws://{host}{STREAM}") as (reader,):
            present_s = time.monotonic() + reader.ahead_s
        page = frames_of_the_page(args.url, args.seconds)
        viser = frames_of_viser(reader.reader, present_s, args.seconds)
        found["browser"] = {"page": page, "viser": viser}
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
