"""A headless Chromium driven over its DevTools protocol: opens a page, reads it, clicks, takes pictures.

    with Browser(url) as browser:
        browser.wait_for_text("updates")
        browser.click_text("Pause")
        image = browser.screenshot()

Nothing outside the machine is contacted: background services of the browser are off, and ``requests``
lists every address that the page asked for.
"""

import base64
import contextlib
import itertools
import json
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
import websocket
from numpy.typing import NDArray

from tests.support import wait_until

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--headless=new --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --disable-background-networking "
    "--disable-component-update --disable-dev-shm-usage --disable-sync --hide-scrollbars --no-first-run "
    "--remote-debugging-port=0 --remote-allow-origins=*"
)

# The middle of the button that shows what is looked for.
_FIND = """
(wanted) => {
  const found = [...document.querySelectorAll('button')].find((e) => e.innerText.includes(wanted));
  found?.scrollIntoView({block: 'center'});
  const r = found?.getBoundingClientRect();
  return r?.width ? [r.x + r.width / 2, r.y + r.height / 2] : null;
}
"""


def chromium() -> str:
    """Path of an installed Chromium, or skip with the reason."""
    found = next((path for name in NAMES if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is installed")
    return found


class Browser(contextlib.AbstractContextManager):
    """One page in one fresh browser. Every wait raises AssertionError with what the page shows instead."""

    def __init__(self, url: str, width: int = 1600, height: int = 900, timeout_s: float = 60.0) -> None:
        self.timeout_s = timeout_s
        self.requests: list[str] = []
        self.errors: list[str] = []
        self._ids = itertools.count(1)
        self._profile = tempfile.mkdtemp(prefix="freshfield-browser-")
        self._socket: websocket.WebSocket | None = None
        self._process = subprocess.Popen(
            [
                chromium(),
                *FLAGS.split(),
                f"--window-size={width},{height}",
                f"--user-data-dir={self._profile}",
                "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            address = wait_until(self._debugger, "the browser did not start", timeout_s)
            self._socket = websocket.create_connection(address, timeout=timeout_s, suppress_origin=True)
            for domain in ("Page", "Runtime", "Network", "Log"):
                self.call(f"{domain}.enable")
            # The window's own decorations would eat into the size asked for.
            self.call(
                "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
            )
            self.call("Page.navigate", url=url)
        except BaseException:
            self.close()
            raise

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """End the browser and forget its profile."""
        if self._socket is not None:
            with contextlib.suppress(Exception):
                self._socket.close()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait(timeout=10)
        shutil.rmtree(self._profile, ignore_errors=True)

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """One DevTools command and its result; raises RuntimeError with the browser's message."""
        assert self._socket is not None
        number = next(self._ids)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv())
            if message.get("id") == number:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error'].get('message')}")
                return message.get("result", {})
            self._note(message)

    def evaluate(self, script: str) -> Any:
        """Value of a JavaScript expression; promises are awaited."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"script failed: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def _note(self, event: dict[str, Any]) -> None:
        params = event.get("params", {})
        if event.get("method") == "Network.requestWillBeSent":
            url = params["request"]["url"]
            if not url.startswith(("data:", "blob:")):  # those stay within the page
                self.requests.append(url)
        elif event.get("method") == "Network.webSocketCreated":
            self.requests.append(params["url"])
        elif event.get("method") == "Runtime.exceptionThrown":
            self.errors.append(str(params["exceptionDetails"].get("exception", {}).get("description")))

    def _debugger(self) -> str | None:
        """Address of the first tab's debugger, once the browser has written its port down."""
        file = Path(self._profile) / "DevToolsActivePort"
        assert self._process.poll() is None, f"the browser ended with status {self._process.returncode}"
        lines = file.read_text().splitlines() if file.exists() else []
        if lines:
            with contextlib.suppress(OSError), urlopen(f"http://127.0.0.1:{lines[0]}/json") as reply:
                return next((tab["webSocketDebuggerUrl"] for tab in json.load(reply) if tab["type"] == "page"), None)
        return None

    def text(self) -> str:
        """All text that the page shows."""
        return self.evaluate("document.body ? document.body.innerText : ''") or ""

    def wait_for(self, wanted: Callable[[], Any], what: str) -> Any:
        """First true value of ``wanted``; ``what`` names it in the error."""
        said = f"{what} did not happen; the page shows:\n"
        return wait_until(wanted, lambda: said + self.text(), self.timeout_s)

    def wait_for_text(self, wanted: str) -> str:
        """The page's text, once ``wanted`` is part of it."""
        return self.wait_for(lambda: wanted in (text := self.text()) and text, f"the text {wanted!r}")

    def click(self, x: float, y: float) -> None:
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=float(x), y=float(y))
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=float(x), y=float(y), button="left", clickCount=1)

    def click_text(self, wanted: str) -> None:
        """Click in the middle of the button that shows ``wanted``."""
        at = self.wait_for(lambda: self.evaluate(f"({_FIND})({json.dumps(wanted)})"), f"a {wanted!r}")
        self.click(*at)

    def close_notices(self) -> None:
        """Click away every notification, such as the one that WebGL runs in software."""
        self.evaluate("document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())")
        gone = "!document.querySelector('.mantine-Notification-root')"
        self.wait_for(lambda: self.evaluate(gone), "the end of the notifications")

    def screenshot(self) -> NDArray[np.uint8]:
        """The window as RGB (H, W, 3)."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.uint8)
