"""Two trade-offs between the simulation's accuracy and its cost, measured against exact ages.

- ``duration``: error of the mean age as a function of simulated seconds and of computing time (channel of the
  thesis's chapter 5, exact age by ``closed_forms``).
- ``slots``: bias and speed of sampling the chain at slot boundaries, as a function of the slot length.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from channel_emu.model.chain import two_state_generator
from channel_emu.model.closed_forms import drop_new_age_ms
from channel_emu.model.config import ChannelConfig, channel_from_mapping
from channel_emu.virtual.benchmark import MEAN_MS, PERIOD_MS
from channel_emu.virtual.simulate import SimulationError, simulate
from freshfield.files import format_table, picture, write_csv

Rows = list[dict[str, Any]]

CAMERAS = 18
# (name, mu1, mu2 in 1/ms, mean delays in ms by state, period in ms, slots in ms). The fast chain switches
# many times a period, so sampling at slots is biased; the thesis's does not.
CHAINS = (
    ("fast", 5.0, 5.0, (0.2, 2.0), 2.0, (0.01, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)),
    ("thesis", 1 / 30, 1 / 30, (30.0, 60.0), 30.0, (0.5, 1.0, 2.0, 5.0, 10.0, 30.0)),
)


def measure(quick: bool = False, seed: int = 0) -> dict[str, Rows]:
    """Measure both tables, by name.

    quick: fewer seeds and shorter runs: seconds instead of a minute.
    seed: the first one; the others follow it.
    Raises SimulationError if numba or scipy is missing.
    """
    return {
        "duration": duration(8 if quick else 24, 1000.0 if quick else 10_000.0, seed),
        "slots": chain_slots(6 if quick else 20, 100_000 if quick else 400_000, seed),
    }


def duration(repeats: int, longest_s: float, seed: int = 0) -> Rows:
    """Root mean square error of the mean age of 18 cameras over ``repeats`` seeds, one row a duration from 1
    s to ``longest_s``."""
    exact = drop_new_age_ms(np.zeros((1, 1)), np.array([MEAN_MS]), PERIOD_MS)
    config = channel_from_mapping({"preset": "ch5"})
    _age(config, CAMERAS, 1.0, seed)  # compiles
    rows = []
    seconds = 1.0
    while seconds <= longest_s:
        begun = time.perf_counter()
        found = np.array([_age(config, CAMERAS, seconds, seed + k) for k in range(repeats)])
        rows.append(
            {
                "seconds": seconds,
                "cameras": CAMERAS,
                "repeats": repeats,
                "exact_ms": exact,
                "rms_error_pct": 100 * float(np.sqrt(np.mean((found / exact - 1) ** 2))),
                "wall_ms": (time.perf_counter() - begun) / repeats * 1e3,
            }
        )
        seconds *= 10**0.5
    return rows


def chain_slots(repeats: int, frames: int, seed: int = 0) -> Rows:
    """Bias of sampling the chain at slot boundaries, exact and measured with its 95 % interval, and speed;
    one row a chain and slot length, where ``slot_ms`` 0 means continuous time.

    repeats: number of seeds. frames: number of frames of each run.
    """
    rows = []
    for name, mu1, mu2, means_ms, period_ms, slots_ms in CHAINS:
        generator = two_state_generator(mu1, mu2)
        exact = drop_new_age_ms(generator, np.array(means_ms), period_ms)
        for slot_ms in (0.0, *slots_ms):
            more = {"sampled": "slots", "slot_ms": slot_ms} if slot_ms else {}
            config = channel_from_mapping(
                {
                    "arrivals": {"process": "periodic", "period_ms": period_ms},
                    "service_state": "modulated",
                    "service": {"law": "exponential", "mean_ms": list(means_ms)},
                    "chain": {"mu1_per_ms": mu1, "mu2_per_ms": mu2, **more},
                }
            )
            seconds = frames * period_ms / 1e3
            begun = time.perf_counter()
            found = np.array([_age(config, 1, seconds, seed + k) for k in range(repeats)])
            predicted = drop_new_age_ms(generator, np.array(means_ms), period_ms, slot_ms or None)
            rows.append(
                {
                    "what": f"chain {name}",
                    "slot_ms": slot_ms,
                    "period_ms": period_ms,
                    "bias_exact_pct": 100 * (predicted / exact - 1),
                    "bias_measured_pct": 100 * (float(found.mean()) / exact - 1),
                    "half_width_pct": 100 * _half_width(found) / exact,
                    "camera_s_per_wall_s": repeats * seconds / (time.perf_counter() - begun),
                }
            )
    return rows


_TITLES = {
    "duration": "rms error of the mean age against seconds simulated (chapter 5)",
    "slots": "bias of a slot grid against its length (slot 0: continuous time)",
}


def show(tables: dict[str, Rows]) -> str:
    """The tables as text."""
    return "\n\n".join(f"{_TITLES[name]}\n{format_table(rows)}" for name, rows in tables.items())


def write(tables: dict[str, Rows], out: Path) -> list[Path]:
    """Write OUT/accuracy-NAME.csv for each table and OUT/accuracy.png. Returns the paths. Raises OSError, and
    PlotError without matplotlib."""
    files = {out / f"accuracy-{name}.csv": rows for name, rows in tables.items()}
    for path, rows in files.items():
        write_csv(path, rows)
    with picture(out / "accuracy.png", 1, 2, size=(9, 4)) as axes:
        _draw(tables, *axes[0])
    return [*files, out / "accuracy.png"]


def _draw(tables: dict[str, Rows], left: Any, right: Any) -> None:
    error = [r["rms_error_pct"] for r in tables["duration"]]
    left.loglog([r["seconds"] for r in tables["duration"]], error, "o-", label="seconds simulated")
    left.loglog([r["wall_ms"] / 1e3 for r in tables["duration"]], error, "s--", label="seconds of computing")
    left.set(xlabel="seconds", ylabel="rms error of the mean age (%)", title="18 cameras, chapter 5")
    left.legend()
    for what in dict.fromkeys(r["what"] for r in tables["slots"]):
        rows = [r for r in tables["slots"] if r["what"] == what and r["slot_ms"]]
        slots = [r["slot_ms"] / r["period_ms"] for r in rows]
        (line,) = right.plot(slots, [r["bias_exact_pct"] for r in rows], "-", label=f"{what}, exact")
        right.errorbar(
            slots,
            [r["bias_measured_pct"] for r in rows],
            [r["half_width_pct"] for r in rows],
            fmt="o",
            color=line.get_color(),
            label=f"{what}, measured",
        )
    right.set(xscale="log", xlabel="slot / period", ylabel="bias of the mean age (%)", title="Slot grids")
    right.set_yscale("symlog", linthresh=0.1)
    right.legend(fontsize="small")


def _age(config: ChannelConfig, cameras: int, seconds: float, seed: int) -> float:
    """Mean age in ms over the cameras that had a delivery. Raises SimulationError if none had."""
    age = simulate(config, cameras, seconds, seed, engine="kernel").mean_age_ms()
    if age is None:
        raise SimulationError(f"nothing was delivered within {seconds:g} s")
    return age


def _half_width(values: np.ndarray) -> float:
    """Half width of the 95 % interval of the mean, by Student's t."""
    try:
        from scipy.stats import t
    except ImportError:
        raise SimulationError("intervals need scipy (pip install 'freshfield[edge]')") from None
    return float(t.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5)
