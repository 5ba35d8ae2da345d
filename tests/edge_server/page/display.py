"""What the page adds to the age of a picture: a real page in a headless Chromium, on this machine.

    python -m tests.edge_server.page.display --json docs/results/display.json

A field is published each 20 ms and the page shows it as it shows any. Each picture carries the instant for
which it was rendered as a shade of gray, and the browser's screencast says when that shade was on the screen.
At a random moment the screen is late by the rendering, the way to the browser, its painting, and the time
that the picture has stood there since. Headless, the browser draws without a GPU, which takes most of that
time and grows with the window.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edge_server.page import start_page
from edge_server.report.machine import machine
from tests.edge_server.page.browser import Browser
from tests.edge_server.page.preview import BallScene, Preview

PUBLISH_S = 0.02
SIZES = ((800, 450), (1600, 900))  # of the window, pixels
TICK_MS, SHADES = 20, 60  # a shade lasts a tick; they repeat after 1.2 s
_FIRST, _STEP = 64, 3  # of gray: lighter than the backdrop, and told apart after JPEG


class Stamped(BallScene):
    """The preview's scene, its picture filled with the shade of the instant that it is rendered for."""

    present_ns = 0

    def at(self, present_ns: int) -> Stamped:
        shown = Stamped(present_ns / 1e9)
        shown.present_ns = present_ns
        return shown

    def render(self, *camera: Any) -> Any:
        image = super().render(*camera)
        shade = _FIRST + _STEP * (self.present_ns // (TICK_MS * 1_000_000) % SHADES)
        return replace(image, color=np.full_like(image.color, shade / 255.0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result here")
    parser.add_argument("--seconds", type=float, default=20.0, metavar="S", help="of each [%(default)g]")
    args = parser.parse_args()
    found: dict[str, Any] = {}
    for width, height in SIZES:
        with tempfile.TemporaryDirectory() as folder:
            found[f"{width} x {height}"] = measure(Path(folder), args.seconds, width, height)
    found |= {"machine": machine(), "load_average": round(os.getloadavg()[0], 1)}
    text = json.dumps(found, indent=1)
    print(text)
    if args.json:
        args.json.write_text(text + "\n")


def measure(folder: Path, seconds: float, width: int, height: int) -> dict[str, Any]:
    """``delays`` in a window of ``width`` x ``height`` pixels."""
    preview, over = Preview(folder), threading.Event()
    page = start_page(preview.state, "127.0.0.1", 0)

    def publish() -> None:
        while not over.wait(PUBLISH_S):
            if last := preview.state.newest():
                now = {"number": last.number + 1, "t_s": preview.state.now_s()}
                preview.state.publish(replace(last, **now, published_ns=time.time_ns()), Stamped(0.0))

    preview.start()
    thread = threading.Thread(target=publish)
    thread.start()
    try:
        with Browser(page.url, width, height, timeout_s=90.0) as browser:
            browser.wait_for_text("PSNR")
            browser.close_notices()
            seen = screencast(browser, seconds)
    finally:
        over.set()
        thread.join()
        page.stop()
        preview.stop()
    return delays(seen)


def screencast(browser: Browser, seconds: float) -> list[tuple[float, int]]:
    """Milliseconds of the wall clock and shade of each frame that the browser has put on the screen."""
    seen, taken = [], []
    note = browser._note

    def noted(event: dict[str, Any]) -> None:
        note(event)
        if event.get("method") == "Page.screencastFrame":
            params = event["params"]
            taken.append(params["sessionId"])
            data = np.frombuffer(base64.b64decode(params["data"]), np.uint8)
            image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
            assert image is not None
            y, x = (side // 2 for side in image.shape)
            shade = round(float(np.median(image[y - 8 : y + 8, x - 8 : x + 8])))
            seen.append((1e3 * params["metadata"]["timestamp"], shade))

    browser._note = noted  # type: ignore[method-assign]
    browser.call("Page.startScreencast", format="png", maxWidth=400, maxHeight=225)
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        browser.evaluate("1")  # brings in what has happened
        while taken:
            browser.call("Page.screencastFrameAck", sessionId=taken.pop())
        time.sleep(0.002)
    return seen


def delays(seen: list[tuple[float, int]]) -> dict[str, Any]:
    """Milliseconds from the instant for which a picture was rendered until it was on the screen, and until a
    random moment at which somebody looks; pictures a second."""
    new, shown = [], []  # instants at which a picture appeared, and the lateness then
    for at_ms, shade in seen:
        number, rest = divmod(shade - _FIRST, _STEP)
        if not 0 <= number < SHADES or rest > 1:
            continue
        period_ms = TICK_MS * SHADES
        late_ms = (at_ms - TICK_MS * (number + 0.5)) % period_ms
        if not shown or at_ms - new[-1] + shown[-1] - late_ms > TICK_MS / 2:  # another picture
            new.append(at_ms)
            shown.append(late_ms)
    stood_ms = np.diff(new)
    late = np.array(shown[:-1])
    return {
        "pictures": len(shown),
        "pictures_per_s": round(1e3 * len(stood_ms) / (new[-1] - new[0]), 1),
        "appears_ms": {f"p{q}": round(float(np.percentile(shown, q))) for q in (50, 95)},
        "seen_mean_ms": round(float(((late + stood_ms / 2) * stood_ms).sum() / stood_ms.sum())),
    }


if __name__ == "__main__":
    main()
