"""Benchmarks the links in virtual time: their speed compared with a plain loop, and the cost of a frame.

The loop steps every link in every slot, as the thesis describes. It is as fast as plain Python allows, for a
fair comparison.
"""

from __future__ import annotations

import math
import random
import statistics
import time
from typing import Any

from channel_emu.model.channel import Channel
from channel_emu.model.config import ChannelConfig, channel_from_mapping
from channel_emu.virtual.simulate import simulate

_CHANCE = {"probability": 0.1}
FAULTS: dict[str, dict[str, Any]] = {
    "loss": _CHANCE,
    "duplication": _CHANCE,
    "corruption": _CHANCE,
    "blackout": {"every_ms": 1000.0, "for_ms": 50.0},
    "reset": {"mean_interval_ms": 1000.0},
    "bandwidth": {"megabits_per_s": 1000.0},
    "mahimahi": {"opportunities_ms": [1] * 20},
}
_PERIOD_NS = 10**6
PERIOD_MS, MEAN_MS = 30.0, 60.0  # period of captures and mean delay in the thesis's chapter 5


def periodic_loop(cameras: int, seconds: float, seed: int = 0, slot_ms: float = 1.0) -> float:
    """Mean age in ms at slot boundaries, just after deliveries, of D/M/1/0 links stepped slot by slot (5.2,
    5.5)."""
    draw = random.Random(seed).expovariate
    every, rate = round(PERIOD_MS / slot_ms), slot_ms / MEAN_MS
    left, sending, newest = [0] * cameras, [0] * cameras, [0] * cameras
    links = range(cameras)
    total = 0
    slots = round(seconds * 1e3 / slot_ms)
    for now in range(slots):
        boundary = now % every == 0
        for link in links:
            busy = left[link]
            if busy:
                left[link] = busy = busy - 1
                if not busy:
                    newest[link] = sending[link]
            if boundary and not busy:
                sending[link] = now
                left[link] = math.ceil(draw(rate))
            total += now - newest[link]
    return total * slot_ms / (slots * cameras)


def bench_simulate(
    cameras: int = 18, seconds: float = 2000.0, rounds: int = 5, loop_seconds: float = 60.0
) -> dict[str, Any]:
    """Speed in link-slots (of 1 ms) a second of wall time: simulator with and without ages, and plain loop.

    cameras: number of links. seconds: simulated in each round. rounds: number of seeds.
    loop_seconds: simulated by the loop in each round.
    Simulator and loop alternate, so that both see the same machine load. Speeds are medians, without compile
    time.
    """
    config = channel_from_mapping({"preset": "ch5"})
    simulate(config, cameras, 1.0, engine="kernel")
    decide, with_ages, loop = [], [], []
    found: list[float] = []
    stepped: list[float] = []
    for seed in range(rounds):
        begun = time.perf_counter()
        result = simulate(config, cameras, seconds, seed, engine="kernel")
        decided = time.perf_counter()
        found.append(result.mean_age_ms() or 0.0)
        decide.append(cameras * seconds * 1e3 / (decided - begun))
        with_ages.append(cameras * seconds * 1e3 / (time.perf_counter() - begun))
        begun = time.perf_counter()
        stepped.append(periodic_loop(cameras, loop_seconds, seed))
        loop.append(cameras * loop_seconds * 1e3 / (time.perf_counter() - begun))
    speeds = {"decisions": decide, "decisions_and_ages": with_ages, "plain_loop": loop}
    return {
        "preset": "ch5",
        "cameras": cameras,
        "seconds": seconds,
        "loop_seconds": loop_seconds,
        "rounds": rounds,
        **{f"{name}_million_link_slots_per_s": statistics.median(v) / 1e6 for name, v in speeds.items()},
        "times_the_loop": statistics.median(with_ages) / statistics.median(loop),
        "mean_age_ms": statistics.fmean(found),
        "loop_mean_age_ms": statistics.fmean(stepped),
    }


def bench_cost(frames: int = 1000, rounds: int = 41) -> list[dict[str, Any]]:
    """Time per frame of an ideal Python link, and the time that each option of a channel adds, in ns.

    frames: number of frames of each measurement.
    Every round measures all options, and ``added_ns`` is the difference to the ideal link in the same round,
    so that other load affects both sides. Rows of medians: what, ns_per_frame, added_ns.
    """
    cases: dict[str, ChannelConfig] = {"ideal link": channel_from_mapping({})}
    for name, params in FAULTS.items():
        cases[f"fault {name}"] = channel_from_mapping({"faults": {name: params}})
    for what, section in {
        "service exponential": {"service": "exp:0.01ms"},
        "service gamma": {"service": "gamma:0.01ms:2"},
        "service lognormal": {"service": "lognormal:0.01ms:0.5"},
        "chain of two states": {"chain": "mu1=1/30,mu2=1/30"},
        "chain at 1 ms slots": {"chain": "mu1=1/30,mu2=1/30,slots=1ms"},
        "Poisson sampling": {"arrivals": "poisson:100"},
        "server of 18 cameras": {"server": {"shared": True}},
    }.items():
        cases[what] = channel_from_mapping(section)
    spent: dict[str, list[float]] = {what: [] for what in cases}
    for _ in range(rounds):
        for what, config in cases.items():
            spent[what].append(_ns_per_frame(config, frames))
    ideal = spent["ideal link"]
    return [
        {
            "what": what,
            "ns_per_frame": statistics.median(values),
            "added_ns": statistics.median([value - base for value, base in zip(values, ideal)]),
        }
        for what, values in spent.items()
    ]


def _ns_per_frame(config: ChannelConfig, frames: int) -> float:
    channel = Channel(config, 0)
    links = [channel.link(f"cam{i:02d}") for i in range(18 if config.server.shared else 1)]
    offers = [links[n % len(links)].offer for n in range(frames)]
    begun = time.perf_counter_ns()
    for n, offer in enumerate(offers):
        offer(n * _PERIOD_NS, None, 20_000)
    return (time.perf_counter_ns() - begun) / frames
