"""Contact sheet: every camera of a scene at one instant.

python -m camera_node.synthetic.preview room --out room.png --size 256 --at 1.0 --set speed_m_per_s=2
"""

from __future__ import annotations

import argparse
import math
import sys

import cv2
import numpy as np

from camera_node.synthetic.render import Image
from camera_node.synthetic.scene import SCENES, Scene, SceneError, make_scene
from freshfield.files import out_file, write_bytes
from freshfield.untrusted import UntrustedError, read_yaml


def contact_sheet(scene: Scene, t_s: float) -> Image:
    """Images of all cameras at an instant, labeled, in a nearly square grid: uint8 RGB."""
    names = list(scene.cameras)
    columns = math.ceil(math.sqrt(len(names)))
    rows = math.ceil(len(names) / columns)
    height, width = scene.params.height, scene.params.width
    gap = max(1, width // 64)
    sheet = np.full((rows * (height + gap) + gap, columns * (width + gap) + gap, 3), 24, dtype=np.uint8)
    for k, name in enumerate(names):
        y, x = gap + (k // columns) * (height + gap), gap + (k % columns) * (width + gap)
        image = scene.render(name, t_s)
        print(f"  {name}: {k + 1} of {len(names)} pictures", file=sys.stderr, flush=True)
        scale = width / 400
        for color, thick in ((0, 3), (255, 1)):
            at = (int(6 * scale) + 2, int(14 * scale) + 6)
            text = (color, color, color)
            cv2.putText(image, name, at, cv2.FONT_HERSHEY_SIMPLEX, max(scale, 0.3), text, thick, cv2.LINE_AA)
        sheet[y : y + height, x : x + width] = image
    return sheet


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    parser = argparse.ArgumentParser(description="tile all cameras of a scene at an instant into a PNG")
    parser.add_argument("scene", choices=SCENES)
    parser.add_argument("--out", type=out_file, required=True, help="PNG file to write")
    parser.add_argument("--at", type=float, default=0.0, metavar="S", help="instant in seconds [%(default)g]")
    parser.add_argument("--size", type=int, default=256, metavar="PX", help="side of each image [%(default)s]")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="scene parameter; may be repeated"
    )
    args = parser.parse_args(arguments)
    if args.out.suffix != ".png":
        parser.error(f"--out {args.out}: expected a file.png")
    try:
        params = {k: read_yaml(v) for k, _, v in (s.partition("=") for s in args.set)}
        scene = make_scene(args.scene, {"count": 19, "width": args.size, "height": args.size, **params})
        sheet = contact_sheet(scene, args.at)
    except (SceneError, UntrustedError) as error:
        parser.error(str(error))
    except KeyboardInterrupt:
        print("\nstopped; nothing was written", file=sys.stderr)
        return 130
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(args.out, cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))[1].tobytes())
    print(args.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
