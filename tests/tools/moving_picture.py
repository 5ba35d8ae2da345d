"""The moving picture of the README: a running page, looked at by headless Chromium, as animated WebP.

    freshfield demo card --for 90s & python -m tests.tools.moving_picture http://127.0.0.1:8080 docs/page.webp

Where taking a picture takes longer than ``EVERY_S``, as on a busy machine, the film runs faster than the scene did.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from PIL import Image

from tests.edge_server.page.browser import Browser

SIZE = (1280, 720)
SHOWN = (800, 450)
FRAMES, EVERY_S = 16, 0.5
QUALITY = 60  # of WebP: below 2 MB


def main() -> None:
    """Take the pictures and write the file."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("url", help="address of the page")
    parser.add_argument("file", type=Path, help="the .webp to write")
    parser.add_argument(
        "--after", default="dB", metavar="TEXT", help="begin once the page shows this text [%(default)s]"
    )
    args = parser.parse_args()
    pictures: list[Image.Image] = []
    with Browser(args.url, *SIZE, timeout_s=120.0) as browser:
        browser.wait_for_text(args.after)
        browser.close_notices()
        for _ in range(FRAMES):
            began = time.monotonic()
            pictures.append(Image.fromarray(browser.screenshot()).resize(SHOWN, Image.Resampling.LANCZOS))
            time.sleep(max(0.0, EVERY_S - (time.monotonic() - began)))
    pictures[0].save(
        args.file, save_all=True, append_images=pictures[1:], duration=round(1e3 * EVERY_S), loop=0, quality=QUALITY
    )
    print(f"{args.file}: {len(pictures)} pictures, {args.file.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
