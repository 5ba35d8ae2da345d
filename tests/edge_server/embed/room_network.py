"""Writes a depth network that knows ``room``, for measuring what a network of the user's is worth; no real one was run.

  python -m tests.edge_server.embed.room_network OUT --cameras 4
  edge-server simulate OUT/with.yaml --seed 7 --seconds 12 --json
  edge-server simulate OUT/without.yaml --seed 7 --seconds 12 --json

OUT/network.onnx remembers the cameras' backgrounds, and answers with their true inverse depth, as networks err: see
``relative_of``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from tests.conftest import ROOT
from tests.edge_server.embed.depth_graphs import remembering
from tests.edge_server.fields.splat.layers.depth.room_plates import relative_of, room_plates


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--cameras", type=int, default=4, help="that train; one more is held out")
    given = parser.parse_args()
    plates, depths = room_plates(given.cameras)
    relative = np.stack([relative_of(depth, k) for k, depth in enumerate(depths)])
    given.out.mkdir(parents=True, exist_ok=True)
    remembering(given.out / "network.onnx", np.stack([p.color.astype(np.uint8) for p in plates]), relative)
    quad = (ROOT / "deploy/scenarios/quad.yaml").read_text().replace("count: 5", f"count: {given.cameras + 1}")
    rig = "".join(line for line in quad.splitlines(keepends=True) if "depth_sensor: {}" not in line)
    (given.out / "without.yaml").write_text(rig)
    (given.out / "with.yaml").write_text(f"{rig}\nedge: {{depth_network: network.onnx}}\n")


if __name__ == "__main__":
    main()
