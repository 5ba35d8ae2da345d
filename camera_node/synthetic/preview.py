"""Contact sheet: every camera of a scene at one instant.

python -m camera_node.synthetic.preview room --out room.png --size 256 --at 1.0 --set speed_m_per_s=2
"""

from __future__ import annotations

import argparse
import math

import cv2
import numpy as np
import yaml

from camera_node.synthetic.render import Image
from camera_node.synthetic.scene import SCENES, Scene, make_scene


def contact_sheet(scene: Scene, t_s: float) -> Image:
    """All cameras side by side, named, uint8 RGB; as square as it gets."""
    names = list(scene.cameras)
    columns = math.ceil(math.sqrt(len(names)))
    rows = math.ceil(len(names) / columns)
    height, width = scene.params.height, scene.params.width
    gap = max(1, width // 64)
    sheet = np.full((rows * (height + gap) + gap, columns * (width + gap) + gap, 3), 24, dtype=np.uint8)
    for k, name in enumerate(names):
        y, x = gap + (k // columns) * (height + gap), gap + (k % columns) * (width + gap)
        image = scene.render(name, t_s)
        scale = width / 400
        for color, thick in ((0, 3), (255, 1)):
            at = (int(6 * scale) + 2, int(14 * scale) + 6)
            text = (color, color, color)
            cv2.putText(image, name, at, cv2.FONT_HERSHEY_SIMPLEX, max(scale, 0.3), text, thick, cv2.LINE_AA)
        sheet[y : y + height, x : x + width] = image
    return sheet


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="tile all cameras of a scene at an instant into a PNG")
    parser.add_argument("scene", choices=SCENES)
    parser.add_argument("--out", required=True, help="PNG file to write")
    parser.add_argument("--at", type=float, default=0.0, metavar="S", help="instant in seconds")
    parser.add_argument("--size", type=int, default=256, metavar="PX", help="side of each picture")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="scene parameter")
    args = parser.parse_args(arguments)
    params = {k: yaml.safe_load(v) for k, _, v in (s.partition("=") for s in args.set)}
    scene = make_scene(args.scene, {"count": 19, "width": args.size, "height": args.size, **params})
    sheet = contact_sheet(scene, args.at)
    if not cv2.imwrite(args.out, cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR)):
        raise SystemExit(f"cannot write {args.out}")


if __name__ == "__main__":
    main()
