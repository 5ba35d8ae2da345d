"""Cost of a frame of the splat page in headless Chromium, and of viser's renderer of the same Gaussians."""

from __future__ import annotations

import json
import os
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from edge_server.fields.splat.kernels.project import COLOR, OPACITY, POSITION, QUATERNION, SCALE
from edge_server.page.splats.messages import StreamReader
from freshfield.geometry import quaternion_to_matrix
from tests.edge_server.page.browser import Browser
from tests.support import free_port

SIZE = (800, 450)
SETTLE_S = 5.0
UPDATES_PER_S = 10.0  # of viser's Gaussians, as often as the stream sends its moving set
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")

# Counts frames in which something is drawn: viser's page draws only what has changed.
COUNT_FRAMES = """
if (window.counted === undefined) {
  let drawn = false;
  for (const name of ["drawArrays", "drawElements", "drawArraysInstanced", "drawElementsInstanced"]) {
    const draw = WebGL2RenderingContext.prototype[name];
    WebGL2RenderingContext.prototype[name] = function (...values) { drawn = true; draw.apply(this, values); };
  }
  (function next() { window.counted += drawn; drawn = false; requestAnimationFrame(next); })();
}
window.counted = 0;
"""


def frames(browser: Browser, seconds: float) -> dict[str, float]:
    """Frames a second; processor time of a frame, of all of the browser's processes; JavaScript's share of the main
    thread."""
    browser.call("Performance.enable", timeDomain="threadTicks")
    browser.evaluate(COUNT_FRAMES)
    began_s, before, used_s = time.monotonic(), _script_s(browser), _cpu_s(browser)
    time.sleep(seconds)
    count, script_s, used_s = browser.evaluate("window.counted"), _script_s(browser) - before, _cpu_s(browser) - used_s
    took_s = time.monotonic() - began_s
    return {
        "frames_per_s": round(count / took_s, 2),
        "processor_ms_a_frame": round(1e3 * used_s / max(count, 1)),
        "main_thread": round(script_s / took_s, 3),
    }


def _script_s(browser: Browser) -> float:
    found = browser.call("Performance.getMetrics")["metrics"]
    return next(each["value"] for each in found if each["name"] == "ScriptDuration")


def _cpu_s(browser: Browser) -> float:
    """Processor seconds so far of the browser's processes, which are one session."""
    ticks = 0
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it has ended
        if int(fields[3]) == browser._process.pid:
            ticks += int(fields[11]) + int(fields[12])
    return ticks / _TICKS_PER_S


def frames_of_the_page(url: str, seconds: float) -> dict[str, Any]:
    """The splat page, with all pixels, beside a stream."""
    with Browser(f"{url.rstrip('/')}/splats/?full", *SIZE) as browser:
        browser.wait_for(lambda: browser.evaluate("window.splats && splats.reader.shown.total"), "Gaussians")
        time.sleep(SETTLE_S)
        browser.evaluate("for (const k of ['draw', 'read']) splatStats[k].length = 0")
        found = frames(browser, seconds)
        stats = json.loads(browser.evaluate("JSON.stringify(splatStats)"))
    # Means: each reading has a step of .1 ms.
    means = {f"ms_of_a_{name}": round(float(np.mean(stats[name])), 3) for name in ("draw", "read")}
    return {"pixels": SIZE, "gaussians": stats["drawn"]} | found | means


def frames_of_viser(reader: StreamReader, instant_s: float, seconds: float) -> dict[str, Any]:
    """The same Gaussians in viser's page, from the same place, set anew UPDATES_PER_S times a second."""
    scene, start = reader.scene, reader.status["start"]
    assert scene is not None
    params = reader.at(instant_s).astype(np.float64)
    server = viser.ViserServer("127.0.0.1", free_port(), verbose=False)
    server.initial_camera.position, server.initial_camera.look_at = start["position"], start["look_at"]
    server.initial_camera.up, server.initial_camera.fov = start["up"], start["fov"]
    places = params[:, POSITION:SCALE] * scene.radius_m + np.array(scene.center_m)
    handle = server.scene.add_gaussian_splats("/splats", *_of_viser(places, params, scene.radius_m))
    stop = threading.Event()

    def update() -> None:
        step = 0
        while not stop.wait(1.0 / UPDATES_PER_S):
            step += 1
            handle.centers = (places + 1e-3 * (step % 2)).astype(np.float32)

    thread = threading.Thread(target=update, daemon=True)
    try:
        with Browser(f"http://127.0.0.1:{server.get_port()}/", *SIZE) as browser:
            browser.wait_for(lambda: browser.evaluate("document.querySelector('canvas') !== null"), "the canvas")
            time.sleep(2.0 * SETTLE_S)
            still = frames(browser, seconds)
            thread.start()
            return {"pixels": SIZE, "gaussians": len(params), "still": still} | frames(browser, seconds)
    finally:
        stop.set()
        server.stop()


def _of_viser(places: NDArray, params: NDArray, radius_m: float) -> tuple[NDArray, ...]:
    """Centers, covariances, colors and opacities as viser takes them."""
    turns = np.stack([quaternion_to_matrix(q / np.linalg.norm(q)) for q in params[:, QUATERNION:OPACITY]])
    scaled = turns * (np.exp(params[:, None, SCALE:QUATERNION]) * radius_m)
    covariances = scaled @ scaled.transpose(0, 2, 1)
    opacities = 1.0 / (1.0 + np.exp(-params[:, OPACITY : OPACITY + 1]))
    colors = params[:, COLOR : COLOR + 3].clip(0.0, 1.0)
    return tuple(each.astype(np.float32) for each in (places, covariances, colors, opacities))
