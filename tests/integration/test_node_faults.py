"""A node and its books when processes die: its peer again and again, or the node itself."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import sys
import time

import yaml

from freshfield import ledger
from tests.camera_node.sources.datasets.photos import write_photos
from tests.integration.peer import Peer
from tests.integration.test_node_stream import books, check_books, make_node, run_while

CAMERAS = ["cam00", "cam01", "cam02"]


async def test_a_peer_that_comes_late_and_dies_again_and_again(tmp_path):
    peer = await Peer().start()
    await peer.stop()  # the port is known now, and nobody listens
    node = make_node(tmp_path, peer.address)
    gaps_s = []

    async def work():
        await asyncio.sleep(0.7)
        for _ in range(4):
            begin = time.perf_counter()
            await peer.start()
            await peer.until_each(CAMERAS, 5)
            gaps_s.append(time.perf_counter() - begin)
            await peer.stop()
            await asyncio.sleep(0.3)
        await peer.start()
        await peer.until_each(CAMERAS, 5)

    await run_while(node, work())
    await peer.stop()
    counts = check_books(tmp_path / "out")
    for camera in CAMERAS:
        sequences = [f.sequence for f in peer.frames if f.camera == camera]
        assert sequences == sorted(set(sequences))
        assert len(sequences) <= counts[camera]["sent"] <= len(sequences) + counts[camera]["broken"]
        assert node.senders[camera].connections >= 5
    # Back-off is capped: five frames at 20 a second arrive within seconds of every restart.
    assert max(gaps_s) < 10
    # What waited through an outage was replaced by newer captures, not kept.
    late_ms = [(a - f.generated_edge_ns) / 1e6 for a, f in zip(peer.arrived_ns, peer.frames)]
    assert sorted(late_ms)[len(late_ms) // 2] < 100 and max(late_ms) < 1000


async def test_sigterm_ends_cleanly_with_the_last_answer(tmp_path):
    peer = await Peer().start()
    source = {"kind": "transforms", "data": str(write_photos(tmp_path / "data", 24)), "fps": 50, "codec": "png"}
    scenario = {"name": "photos", "cameras": {"count": 3, "held_out": ["cam00"]}, "source": source}
    (file := tmp_path / "photos.yaml").write_text(yaml.safe_dump(scenario))
    command = [sys.executable, "-m", "camera_node.cli", "run", str(file), "--all", "--to", peer.address, "--quiet"]
    node = subprocess.Popen([*command, "--out", str(tmp_path / "out")], stderr=subprocess.PIPE)
    await peer.until_each(CAMERAS, 10)
    status = json.loads((tmp_path / "out" / "node-cam00+2.json").read_text())
    node.send_signal(signal.SIGTERM)
    _, said = await asyncio.to_thread(node.communicate, timeout=5)
    await peer.stop()
    assert (node.returncode, said) == (0, b"")
    assert status["phase"] in ("preparing", "streaming") and status["cameras"]["cam02"]["fps"] == 50
    (file,) = ledger.read_all(tmp_path / "out")
    assert file.events and file.closed and not file.torn
    assert all(c["sent"] == c["answered"] for c in books(tmp_path / "out").values())
