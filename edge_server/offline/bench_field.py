"""How fast the field is: steps, rays, samples, renderings, compilation, memory, seconds to a quality."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from edge_server.fidelity.psnr import psnr
from edge_server.fields import Budget, Field
from edge_server.offline.still import Still, synthetic
from edge_server.offline.usage import Usage, peak_rss_mb
from freshfield.geometry import Pinhole

FIELD = "ngp"
VIEWS, SIZE = 18, 128
TARGETS_DB = (22, 25, 28, 30)
_FIRST_SLICE_S, _GROWTH = 0.25, 1.25


def measure(quick: bool, folder: Path, lpips: Path | None = None) -> dict[str, Any]:
    """All figures of the field; ``folder`` takes a fresh kernel cache."""
    del lpips  # fidelity is not measured here
    figures: dict[str, Any] = {"start": _start_up(quick, folder)}
    for name in ("tile", "room"):
        still = synthetic(name, cameras=VIEWS + 1, size=SIZE)
        figures[name] = {
            **_speed(still, repeats=3 if quick else 9),
            "seconds_to_db": _seconds_to(still, limit_s=8.0 if quick else 40.0),
        }
    return figures


def _new_field() -> Field:
    from edge_server.fields.registry import make_field

    return make_field(FIELD)


def _start_up(quick: bool, folder: Path) -> dict[str, Any]:
    """Compile times and memory, each in a process of its own, cold with an empty kernel cache."""
    usage = Usage("bench")
    figures = {}
    if not quick:
        figures["jit_cold_s"] = _child(folder / "numba")["jit_s"]
        cached = _child(folder / "numba")
    else:
        _child(None)  # fills the cache if nobody has
        cached = _child(None)
    figures["jit_cached_s"] = cached["jit_s"]
    figures["peak_rss_mb"] = cached["peak_rss_mb"]
    figures["machine_cores_busy"] = usage.row(0.0).get("machine", {}).get("cpu")
    return figures


def _child(cache: Path | None) -> dict[str, float]:
    environment = dict(os.environ) if cache is None else {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-m", "edge_server.offline.bench_field"]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def _speed(still: Still, repeats: int) -> dict[str, Any]:
    """Rates of a field that has settled, and milliseconds of a rendering."""
    field = _new_field()
    field.fit(still.training, Budget(seconds=3.0))
    usage = Usage("bench")
    reports = [field.fit(still.training, Budget(seconds=1.0)) for _ in range(repeats)]
    outside = usage.outside(usage.row(0.0))
    pose, lens = still.held_out[0].camera_to_world, still.held_out[0].intrinsics
    return {
        "steps_per_s": statistics.median(r.steps / r.seconds for r in reports),
        "rays_per_s": statistics.median(r.rays / r.seconds for r in reports),
        "samples_per_s": statistics.median(r.samples / r.seconds for r in reports),
        "outside_cores": outside,
        **{f"render_{w}_ms": _render_ms(field, pose, lens.scaled(w / lens.width)) for w in (128, 256)},
    }


def _render_ms(field: Field, pose: Any, lens: Pinhole, repeats: int = 11) -> float:
    spent = []
    for _ in range(repeats):
        began = time.perf_counter()
        field.render(pose, lens)
        spent.append((time.perf_counter() - began) * 1e3)
    return statistics.median(spent)


def _seconds_to(still: Still, limit_s: float) -> dict[str, Any]:
    """Seconds of fitting from scratch until the held-out view first reaches each quality; None: not within
    ``limit_s``. Fitted in growing slices, each of which ends with a settled field."""
    field, truth = _new_field(), still.held_out[0]
    usage = Usage("bench")
    reached: dict[int, float | None] = dict.fromkeys(TARGETS_DB)
    spent, slice_s, best = 0.0, _FIRST_SLICE_S, 0.0
    while spent < limit_s and best < TARGETS_DB[-1]:
        spent += field.fit(still.training, Budget(seconds=slice_s)).seconds
        slice_s *= _GROWTH
        score = psnr(field.render(truth.camera_to_world, truth.intrinsics).color, truth.image)
        best = max(best, score or 0.0)
        for target in TARGETS_DB:
            if best >= target and reached[target] is None:
                reached[target] = spent
    return {
        **{f"{target}_db": seconds for target, seconds in reached.items()},
        "best_db": best,
        "within_s": spent,
        "outside_cores": usage.outside(usage.row(0.0)),
    }


def _main() -> None:
    """In a process of its own: the time until kernels are ready, and what fitting takes of memory."""
    field = _new_field()
    began = time.perf_counter()
    warm_up = getattr(field, "warm_up", None)
    if warm_up is not None:
        warm_up()
    jit_s = time.perf_counter() - began
    still = synthetic("tile", cameras=VIEWS + 1, size=SIZE)
    field.fit(still.training, Budget(steps=20))
    field.render(still.held_out[0].camera_to_world, still.held_out[0].intrinsics)
    print(json.dumps({"jit_s": jit_s, "peak_rss_mb": peak_rss_mb()}))


if __name__ == "__main__":
    _main()
