"""What scenes and effects cost in milliseconds of processor time a frame.

    python -m camera_node.world.bench --size 128 --json bench.json

Medians over frames spread through a period; processor time of all threads, so that what else runs on the
machine counts little. Scenes are rendered ahead and cached, so their cost and that of world and exposure
effects is paid once; only image and clock effects are paid while streaming.
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

from camera_node.world import effects as fx
from camera_node.world.render import Image
from camera_node.world.scene import HELD_OUT, SCENES, make_scene


def measure_ms(*calls: Callable[[int], object], frames: int) -> list[float]:
    """Median processor milliseconds of each call(k), k = 0 .. frames - 1, after one that does not count.
    The calls take turns, so that a change in the machine's load meets all of them."""
    for call in calls:
        call(0)
    times: list[list[float]] = [[] for _ in calls]
    for k in range(frames):
        for call, row in zip(calls, times):
            start = process_time()
            call(k)
            row.append(1e3 * (process_time() - start))
    return [median(row) for row in times]


def bench_scenes(size: int, frames: int) -> list[dict[str, Any]]:
    """One row for each scene and supersampling: set-up of a camera and a frame without effects."""
    rows = []
    for name in SCENES:
        for supersample in (1, 2):
            scene = make_scene(name, {"width": size, "height": size, "supersample": supersample})
            start = process_time()
            render = scene.renderer(HELD_OUT).image
            setup_ms = 1e3 * (process_time() - start)
            step = scene.period_s / frames
            call = partial(_render_at, render, step)
            (ms,) = measure_ms(call, frames=frames)
            rows.append({"scene": name, "supersample": supersample, "setup_ms": setup_ms, "frame_ms": ms})
    return rows


def bench_effects(size: int, frames: int, scene_name: str = "room") -> list[dict[str, Any]]:
    """One row for each effect with its default parameters, and one for none: added ms a frame, and when
    they are paid."""
    scene = make_scene(scene_name, {"width": size, "height": size})
    plain = scene.renderer(HELD_OUT).image
    step = scene.period_s / frames
    image = plain(0.0)
    rows = []
    for name in (*fx.NAMES, None):
        made = fx.load_effects({name: {}} if name else {}, lambda _: np.random.default_rng(0))
        if made.world or made.exposure:
            render = made.exposed(made.extend(scene).renderer(HELD_OUT).image)
            base, full = measure_ms(
                partial(_render_at, plain, step), partial(_render_at, render, step), frames=frames
            )
            rows.append({"effect": name, "added_ms": full - base, "paid": "ahead"})
        else:
            (added,) = measure_ms(partial(_stream, made, image), frames=frames)
            rows.append({"effect": name or "none listed", "added_ms": added, "paid": "streaming"})
    return rows


def _render_at(render: Callable[[float], Image], step_s: float, k: int) -> Image:
    return render(k * step_s)


def _stream(effects: fx.Effects, image: Image, k: int) -> Image:
    effects.node_ns(k)
    return effects.apply(image, k)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="cost of scenes and effects, ms a frame (medians)")
    parser.add_argument("--size", type=int, default=128, metavar="PX", help="side of the square images")
    parser.add_argument("--frames", type=int, default=60, metavar="N", help="frames each median is over")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also save the figures here")
    args = parser.parse_args(arguments)
    scenes, effects = bench_scenes(args.size, args.frames), bench_effects(args.size, args.frames)
    print(f"{args.size} x {args.size}, one camera, no effects\n")
    print(f"{'scene':<14}{'rays/pixel':>11}{'set-up ms':>11}{'ms a frame':>12}")
    for row in scenes:
        rays = row["supersample"] ** 2
        print(f"{row['scene']:<14}{rays:>11}{row['setup_ms']:>11.0f}{row['frame_ms']:>12.3f}")
    print(f"\n{'effect':<14}{'paid':>11}{'added ms a frame':>23}")
    for row in effects:
        print(f"{row['effect']:<14}{row['paid']:>11}{row['added_ms']:>23.4f}")
    if args.json:
        args.json.write_text(json.dumps({"size": args.size, "scenes": scenes, "effects": effects}, indent=2))


if __name__ == "__main__":
    main()
