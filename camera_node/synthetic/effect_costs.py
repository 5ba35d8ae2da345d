"""Measures the cost of scenes and effects in milliseconds of processor time a frame.

    python -m camera_node.synthetic.effect_costs --size 128x128 640x480 --json costs.json

Values are medians over frames spread through a period, of the processor time of all threads, which other load
affects little. Scenes are rendered ahead and cached, so they and the world, lens and exposure effects cost
once for every different frame; only image, clock and pose effects cost while streaming. An added cost is the
difference to the same frame without the effect, in the same run.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any

import numpy as np

from camera_node.synthetic import effects as fx
from camera_node.synthetic.render import Image
from camera_node.synthetic.scene import HELD_OUT, SCENES, Scene, make_scene
from freshfield.geometry import Pose

# Every effect with its default parameters, and those whose parameters trade accuracy for time.
CASES: tuple[tuple[str, dict[str, Any]], ...] = (
    *((name, {}) for name in fx.NAMES),
    ("motion_blur", {"samples": 2}),
    ("rolling_shutter", {"rows_at_once": 8}),
    ("shadows", {"light_points": 3}),
)
Size = tuple[int, int]


def measure_ms(*calls: Callable[[int], object], frames: int, within_s: float = np.inf) -> list[float]:
    """Median processor milliseconds of each call(k) over k = 0 .. frames - 1, after a warm-up; fewer frames
    if they take longer than ``within_s``."""
    return [median(row) for row in _times_ms(*calls, frames=frames, within_s=within_s)]


def added_ms(base: Callable[[int], object], full: Callable[[int], object], frames: int, within_s: float) -> float:
    """Median extra time of full(k) over base(k), frame by frame, because frames differ."""
    rows = _times_ms(base, full, frames=frames, within_s=within_s)
    return median(b - a for a, b in zip(*rows))


def _times_ms(*calls: Callable[[int], object], frames: int, within_s: float) -> list[list[float]]:
    """Processor milliseconds of each call. Calls alternate, so that changes of the machine's load affect all
    of them. If they take longer than ``within_s`` together, fewer frames are measured, but at least three."""
    for call in calls:
        call(0)
    times: list[list[float]] = [[] for _ in calls]
    for k in range(frames):
        for call, row in zip(calls, times):
            start = process_time()
            call(k)
            row.append(1e3 * (process_time() - start))
        if k >= 2 and sum(map(sum, times)) > 1e3 * within_s:
            break
    return times


def measure_scenes(size: Size, frames: int, within_s: float) -> list[dict[str, Any]]:
    """A row for each scene and supersampling: set-up of a camera, and a frame without effects."""
    rows = []
    for name in SCENES:
        for supersample in (1, 2):
            scene = make_scene(name, {"width": size[0], "height": size[1], "supersample": supersample})
            view, setup_ms = _prepared(scene)
            (ms,) = measure_ms(partial(_render, view, scene.period_s), frames=frames, within_s=within_s)
            rows.append({"scene": name, "supersample": supersample, "setup_ms": setup_ms, "frame_ms": ms})
    return rows


def measure_effects(size: Size, frames: int, within_s: float) -> list[dict[str, Any]]:
    """A row for each of CASES, and one for no effect: added ms a frame, and whether it is paid ahead or while
    streaming.

    setup_ms: once for each camera, if the effect needs its own renderer.
    rms_counts: root mean square difference between a case's frames and those with default parameters.
    """
    scene = make_scene("room", {"width": size[0], "height": size[1], "supersample": 1})
    _prepared(scene)  # the first call of everything takes longer
    plain, _ = _prepared(scene.with_world(scene.world))
    image = plain.image(0.0)
    pose = Pose.from_matrix(scene.cameras[HELD_OUT][1])
    rows: list[dict[str, Any]] = []
    exact: dict[str, Callable[[int], Image]] = {}
    for name, parameters in CASES:
        made = fx.load_effects({name: parameters}, lambda _: np.random.default_rng(0))
        row: dict[str, Any] = {"effect": name, "parameters": parameters}
        if made.world or made.lens or made.exposure:
            changed = plain
            if made.world or made.lens:
                changed, row["setup_ms"] = _prepared(made.extend(scene))
            render = partial(_render, made.with_exposure(changed), scene.period_s)
            added = added_ms(partial(_render, plain, scene.period_s), render, frames, within_s)
            row |= {"paid": "ahead", "added_ms": added}
            exact.setdefault(name, render)
            if parameters:
                gaps = [np.subtract(render(k), exact[name](k), dtype=np.float64) for k in range(4)]
                row["rms_counts"] = float(np.sqrt(np.mean(np.square(gaps))))
        else:
            row |= {"paid": "streaming", "added_ms": _streaming_ms(made, image, pose, frames, within_s)}
        rows.append(row)
    nothing_ms = _streaming_ms(fx.NO_EFFECTS, image, pose, frames, within_s)
    rows.append({"effect": "none listed", "parameters": {}, "paid": "streaming", "added_ms": nothing_ms})
    return rows


def _prepared(scene: Scene) -> tuple[fx.Renderer, float]:
    start = process_time()
    return scene.renderer(HELD_OUT), 1e3 * (process_time() - start)


def _render(view: fx.Renderer, period_s: float, k: int) -> Image:
    # Golden-section steps spread any number of frames over the period.
    return view.image(k * 0.618034 % 1.0 * period_s)


def _streaming_ms(effects: fx.Effects, image: Image, pose: Pose, frames: int, within_s: float) -> float:
    def stream(k: int) -> Image:
        effects.node_ns(k)
        effects.reported_pose(pose, k)
        return effects.apply(image, k, k / 15.0)

    (ms,) = measure_ms(stream, frames=frames, within_s=within_s)
    return ms


def table(size: Size, scenes: list[dict[str, Any]], effects: list[dict[str, Any]]) -> str:
    """The figures of one image size as text."""
    lines = [f"{size[0]} x {size[1]}, one camera, without effects", ""]
    lines.append(f"{'scene':<34}{'rays/pixel':>11}{'set-up ms':>13}{'ms a frame':>19}")
    for row in scenes:
        rays = row["supersample"] ** 2
        lines.append(f"{row['scene']:<34}{rays:>11}{row['setup_ms']:>13.0f}{row['frame_ms']:>19.3f}")
    lines += [
        "",
        f"{'effect (room, 1 ray/pixel)':<34}{'paid':>11}{'set-up ms':>13}{'added ms a frame':>19}"
        f"{'rms counts off':>17}",
    ]
    for row in effects:
        name = " ".join([row["effect"], *(f"{k}={v}" for k, v in row["parameters"].items())])
        setup = f"{row['setup_ms']:.0f}" if "setup_ms" in row else ""
        off = f"{row['rms_counts']:>17.2f}" if "rms_counts" in row else ""
        lines.append(f"{name:<34}{row['paid']:>11}{setup:>13}{row['added_ms']:>19.4f}{off}")
    return "\n".join(lines)


def _size(word: str) -> Size:
    width, _, height = word.partition("x")
    try:
        return int(width), int(height or width)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{word!r}: expected WIDTHxHEIGHT, such as 640x480") from None


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="measure the cost of scenes and effects, in ms per frame (medians)")
    parser.add_argument(
        "--size",
        type=_size,
        nargs="+",
        default=[(128, 128), (640, 480)],
        metavar="WxH",
        help="image sizes [128x128 640x480]",
    )
    parser.add_argument("--frames", type=int, default=60, metavar="N", help="frames per median [%(default)s]")
    parser.add_argument(
        "--within",
        type=float,
        default=1.0,
        metavar="S",
        help="seconds per figure, with fewer frames if slow [%(default)g]",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures to FILE as JSON")
    args = parser.parse_args(arguments)
    saved = []
    for size in args.size:
        scenes = measure_scenes(size, args.frames, args.within)
        effects = measure_effects(size, args.frames, args.within)
        print(table(size, scenes, effects), end="\n\n", flush=True)
        saved.append({"width": size[0], "height": size[1], "scenes": scenes, "effects": effects})
    if args.json:
        args.json.write_text(json.dumps({"sizes": saved}, indent=2))


if __name__ == "__main__":
    main()
