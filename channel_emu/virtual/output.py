"""Writes a simulation to files: one row a frame, and a plot of the ages."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from channel_emu.virtual.link_run import OUTCOME_CODES
from channel_emu.virtual.simulate import Simulation
from freshfield.files import picture, write_csv

_CAMERAS, _DELIVERIES = 4, 60


def write_frames(simulation: Simulation, path: Path) -> None:
    """Write CSV rows offered_ms, delivered_ms (empty: not delivered) and camera, as ``channel-emu fit`` reads
    them. Raises OSError."""
    rows = []
    for run in simulation.runs:
        came = run.outcome == OUTCOME_CODES["delivered"]
        delivered = np.where(came, run.due_ns / 1e6, np.nan).tolist()
        rows += [
            {"offered_ms": at, "delivered_ms": "" if due != due else due, "camera": run.camera}
            for at, due in zip((run.offered_ns / 1e6).tolist(), delivered)
        ]
    write_csv(path, rows)


def plot_ages(simulation: Simulation, path: Path) -> None:
    """Plot the age over time of the first cameras and deliveries, and the distribution of the drawn delays.
    Raises PlotError."""
    with picture(path, 1, 2, size=(11, 4), width_ratios=[2, 1]) as axes:
        age, delay = axes[0]
        for run in simulation.runs[:_CAMERAS]:
            saw = run.sawtooth()
            due, born = saw.delivered_ns[:_DELIVERIES] / 1e6, saw.generated_ns[:_DELIVERIES] / 1e6
            # The age drops at each delivery: plot its value before and after.
            before = np.append(np.nan, due[1:] - born[:-1])[: len(due)]
            age.plot(np.repeat(due, 2) / 1e3, np.stack((before, due - born), 1).ravel(), label=run.camera)
            values = np.sort(run.delays_ms())
            delay.plot(values, (np.arange(len(values)) + 0.5) / max(len(values), 1))
        age.set(xlabel="time (s)", ylabel="age (ms)")
        age.legend(fontsize="small")
        delay.set(xlabel="delay (ms)", ylabel="share below", ylim=(0, 1))
