"""Pictures of a running page for README and docs, by headless Chromium: a .png, or an animated .webp.

    freshfield demo card --for 90s & python -m tests.tools.page_pictures http://127.0.0.1:8080 docs/page.webp
    python -m tests.tools.page_pictures http://127.0.0.1:8080 docs/preferences.png --size 760x800 --after answered

Where taking a picture takes longer than ``EVERY_S``, as on a busy machine, the film runs faster than the scene did.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from PIL import Image

from tests.edge_server.page.browser import Browser

SHOWN = (800, 450)
FRAMES, EVERY_S = 16, 0.5
QUALITY = 60  # of WebP: below 2 MB
COLORS = 256  # of a PNG: below 300 kB


def main() -> None:
    """Take the pictures and write the file."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("url", help="address of the page")
    parser.add_argument("file", type=Path, help="the .png or .webp to write")
    parser.add_argument("--size", default="1280x720", metavar="WxH", help="pixels of the window [%(default)s]")
    parser.add_argument(
        "--after", default="dB", metavar="TEXT", help="begin once the page shows this text [%(default)s]"
    )
    args = parser.parse_args()
    width, height = map(int, args.size.split("x"))
    pictures: list[Image.Image] = []
    still = args.file.suffix == ".png"
    with Browser(args.url, width, height, timeout_s=120.0) as browser:
        browser.wait_for_text(args.after)
        browser.close_notices()
        if still:
            time.sleep(2.0)  # until its pictures are drawn
        for _ in range(1 if still else FRAMES):
            began = time.monotonic()
            pictures.append(Image.fromarray(browser.screenshot()))
            time.sleep(max(0.0, EVERY_S - (time.monotonic() - began)))
    if still:
        pictures[0].quantize(COLORS).save(args.file, optimize=True)
    else:
        first, *more = [picture.resize(SHOWN, Image.Resampling.LANCZOS) for picture in pictures]
        first.save(args.file, save_all=True, append_images=more, duration=round(1e3 * EVERY_S), loop=0, quality=QUALITY)
    print(f"{args.file}: {len(pictures)} pictures, {args.file.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
