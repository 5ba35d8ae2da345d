"""OpenSplat: 3D Gaussian splatting in C++ on libtorch, which also runs on a CPU."""

from __future__ import annotations

import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.experiments.bench.peer.contestant import Contestant, PeerMissing
from edge_server.experiments.scenes.multiview_still import MultiviewStill
from edge_server.export import PosedImage
from edge_server.export.ply import write_points
from edge_server.export.transforms import write_transforms
from edge_server.fields import Budget, View
from edge_server.fields.registry import make_field

# OpenSplat needs initial positions: this number of surface points of our field, fitted for this many seconds.
# Their time is not counted.
POINTS, POINTS_S = 10_000, 2.0
START_S = 120.0


def opensplat(folder: Path, still: MultiviewStill, seed: int) -> Contestant:
    """OpenSplat with its defaults, but images in full size from the start. It renders the held-out view
    itself after every tenth step, which is included in its time (some 3 %). Its process is stopped while it
    is scored.
    Raises PeerMissing if there is no program ``opensplat``, or it does not start."""
    program = shutil.which("opensplat")
    if program is None:
        raise PeerMissing("no program opensplat on the PATH")
    (held_out,) = still.held_out
    field = make_field("splat", seed=seed)
    field.warm_up()
    field.fit(still.training, Budget(seconds=POINTS_S))
    home = Path(tempfile.mkdtemp(prefix="opensplat-", dir=folder))
    points, color = field.points(POINTS)
    shots = [PosedImage(v.camera, v.image, v.camera_to_world, v.intrinsics) for v in (*still.training, held_out)]
    write_transforms(home, shots, "points.ply")
    (home / "images").mkdir()
    for shot in shots:
        cv2.imwrite(str(home / "images" / f"{shot.name}.png"), np.ascontiguousarray(shot.image[..., 2::-1]))
    write_points(home / "points.ply", points, np.round(color * 255.0).astype(np.uint8))
    log = home / "log.txt"
    with log.open("w") as out:
        process = subprocess.Popen(
            [
                program,
                str(home),
                "-o",
                str(home / "out.ply"),
                "--cpu",
                "--num-downscales",
                "0",
                "--val",
                "--val-image",
                f"{held_out.camera}.png",
                "--val-render",
                str(home / "val"),
            ],
            stdout=out,
            stderr=out,
        )
    until = time.monotonic() + START_S
    while "Step 1:" not in log.read_text():
        if process.poll() is not None or time.monotonic() > until:
            process.kill()
            raise PeerMissing(f"opensplat did not start: {log.read_text()[-300:].strip()}")
        time.sleep(0.01)
    process.send_signal(signal.SIGSTOP)

    def train(seconds: float) -> float:
        began = time.perf_counter()
        process.send_signal(signal.SIGCONT)
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGSTOP)
        return time.perf_counter() - began

    def steps() -> int:
        return log.read_text().count("Step ")

    def render(view: View) -> NDArray[np.float32]:
        newest_first = sorted((home / "val").glob("*.png"), key=lambda p: -int(p.stem))
        for path in newest_first:
            if (image := cv2.imread(str(path))) is not None:  # the newest may be half written
                return image[..., ::-1].astype(np.float32) / 255.0
        return np.zeros((view.intrinsics.height, view.intrinsics.width, 3), np.float32)

    def close() -> None:
        process.send_signal(signal.SIGCONT)
        process.kill()
        process.wait()
        shutil.rmtree(home)

    return Contestant(train, render, steps, close)
