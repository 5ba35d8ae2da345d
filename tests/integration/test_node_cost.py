"""What a node costs while it streams: processor time of nine small cameras, memory of one large one."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest
import yaml

from tests.camera_node.sources.datasets.test_video import write_rig
from tests.integration.peer import Peer


def write_scenario(file: Path, cameras: int, **source) -> Path:
    top = {"name": "cost", "cameras": {"count": cameras, "held_out": ["cam00"]}, "source": source}
    file.write_text(yaml.safe_dump(top))
    return file


async def measured(scenario: Path, which: list[str], seconds: float) -> tuple[float, int, int]:
    """(share of one core while streaming, peak resident bytes since the start, frames that arrived)."""
    peer = await Peer().start()
    command = [sys.executable, "-m", "camera_node.cli", "run", str(scenario), *which, "--to", peer.address]
    node = subprocess.Popen([*command, "-q"])
    try:
        process = psutil.Process(node.pid)
        await peer.until(1, timeout_s=240)
        peer.frames.clear()
        begin = process.cpu_times()
        await asyncio.sleep(seconds)
        end = process.cpu_times()
        arrived = len(peer.frames)
        status = Path(f"/proc/{node.pid}/status").read_text()
    finally:
        node.terminate()
        node.wait()
        await peer.stop()
    peak = next(int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith("VmHWM"))
    return (end.user + end.system - begin.user - begin.system) / seconds, peak, arrived


@pytest.mark.slow
def test_nine_small_cameras_cost_little(tmp_path):
    scenario = write_scenario(tmp_path / "nine.yaml", 9, kind="world", scene="room", width=128, height=128, fps=15)
    share, _, arrived = asyncio.run(measured(scenario, ["--all"], 8.0))
    assert arrived > 0.9 * 8 * 9 * 15
    assert share < 0.15


@pytest.mark.slow
def test_one_large_camera_stays_small(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    world = write_scenario(tmp_path / "world.yaml", 2, kind="world", scene="tile", width=640, height=480, fps=15)
    rig = write_rig(tmp_path / "rig", width=640, height=480)
    video = write_scenario(tmp_path / "video.yaml", 2, kind="video", data=str(rig), fps=15)
    for scenario in (world, video):
        _, peak, arrived = asyncio.run(measured(scenario, ["--camera", "cam01"], 3.0))
        assert arrived > 30 and peak < 120e6, scenario.name


def test_noise_that_cannot_be_kept_is_made_as_it_streams(tmp_path, monkeypatch):
    """Every frame differs, none is cached, and the node keeps up."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    source = {"kind": "world", "scene": "tile", "width": 64, "height": 64, "fps": 15, "codec": "png"}
    scenario = write_scenario(tmp_path / "noisy.yaml", 2, **source, effects={"sensor_noise": None})

    async def scene():
        peer = await Peer().start()
        command = [sys.executable, "-m", "camera_node.cli", "run", str(scenario), "--camera", "cam01"]
        node = subprocess.Popen([*command, "--to", peer.address, "-q"])
        try:
            await peer.until(20)
        finally:
            node.terminate()
            node.wait()
            await peer.stop()
        return peer.frames

    frames = asyncio.run(scene())
    images = [cv2.imdecode(np.frombuffer(f.payload, np.uint8), cv2.IMREAD_COLOR).astype(int) for f in frames]
    spread = [np.std(a - b) for a, b in pairwise(images)]
    assert min(spread) > 1.0 and max(spread) < 10.0
