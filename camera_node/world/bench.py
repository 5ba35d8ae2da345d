"""What scenes and effects cost in milliseconds a frame.

    python -m camera_node.world.bench --size 128 --json bench.json

Medians over frames spread through a period. Scenes are rendered ahead and cached, so their cost and that
of world and exposure effects is paid once; only image and clock effects are paid while streaming.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

from camera_node.world import effects as fx
from camera_node.world.scene import HELD_OUT, SCENES, make_scene


def measure_ms(call: Callable[[int], object], frames: int) -> float:
    """Median milliseconds of call(k), k = 0 .. frames - 1, after one call that does not count."""
    call(0)
    times = []
    for k in range(frames):
        start = perf_counter()
        call(k)
        times.append(1e3 * (perf_counter() - start))
    return median(times)


def bench_scenes(size: int, frames: int) -> list[dict[str, Any]]:
    """One row for each scene and supersampling: set-up of a camera and a frame without effects."""
    rows = []
    for name in SCENES:
        for supersample in (1, 2):
            scene = make_scene(name, {"width": size, "height": size, "supersample": supersample})
            start = perf_counter()
            render = scene.renderer(HELD_OUT).image
            setup_ms = 1e3 * (perf_counter() - start)
            step = scene.period_s / frames
            ms = measure_ms(lambda k, render=render, step=step: render(k * step), frames)  # type: ignore[misc]
            rows.append({"scene": name, "supersample": supersample, "setup_ms": setup_ms, "frame_ms": ms})
    return rows


def bench_effects(size: int, frames: int, scene_name: str = "room") -> list[dict[str, Any]]:
    """One row for each effect with its default parameters, and one for none: added ms a frame, and when
    they are paid."""
    scene = make_scene(scene_name, {"width": size, "height": size})
    plain = scene.renderer(HELD_OUT).image
    step = scene.period_s / frames
    image = plain(0.0)
    base_ms = measure_ms(lambda k: plain(k * step), frames)
    rows = []
    for name in fx.NAMES:
        made = fx.load_effects({name: {}}, lambda _: np.random.default_rng(0))
        if made.world or made.exposure:
            render = made.exposed(made.extend(scene).renderer(HELD_OUT).image)
            added = measure_ms(lambda k, render=render: render(k * step), frames) - base_ms  # type: ignore[misc]
            paid = "ahead"
        elif made.image:
            added = measure_ms(lambda k, made=made: made.apply(image, k), frames)  # type: ignore[misc]
            paid = "streaming"
        else:
            added = measure_ms(lambda k, made=made: made.node_ns(k), frames)  # type: ignore[misc]
            paid = "streaming"
        rows.append({"effect": name, "added_ms": added, "paid": paid})
    none = fx.load_effects({}, lambda _: np.random.default_rng(0))
    added = measure_ms(lambda k: none.node_ns(k) and none.apply(image, k), frames)
    rows.append({"effect": "none listed", "added_ms": added, "paid": "streaming"})
    return rows


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
