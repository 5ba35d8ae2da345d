"""Deployments and faults drawn from a seed."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from channel_emu.model.link import DISCIPLINES
from edge_server.scheduler import parse_policy
from freshfield.scenario import Scenario, parse, seed_sequence
from tests.support import small_world

ROLES = ("node", "emulator", "edge")
POLICIES = ("all", "threshold:120", "wait:80", "freshest-k:2", "round-robin:2", "random", "age-driven", "periodic:300")
QUEUE_LIMIT = 4
SECONDS = 4.5
# Faults begin within this part of a run and are over by FAULTS_OVER_S, so that the rest shows the recovery.
_FAULTS_BEGIN_S = (0.3, 2.0)
FAULTS_OVER_S = 2.5
_SMALL = {"gaussians": 300, "start": 200, "seed_cells": 12}


@dataclass(frozen=True)
class Fault:
    """A fault.

    kind: of a process: crash, stall; of a camera: away, clock_step; of the edge: policy, checkpoint.
    at_ms: when it begins. for_ms: how long it lasts; 0 for an instantaneous one.
    target: the process, the camera, or the new policy.
    value: of crash, whether an edge resumes its last checkpoint; of clock_step, ms.
    """

    number: int
    kind: str
    at_ms: float
    for_ms: float = 0.0
    target: str = ""
    value: float = 0.0


def scenario_of(seed: int) -> Scenario:
    """A small deployment: four cameras, and a channel, a field and a policy that the seed chooses."""
    rng = np.random.default_rng(seed_sequence(seed, "chaos", "scenario"))
    discipline = str(rng.choice(DISCIPLINES))
    channel: dict[str, Any] = {"preset": str(rng.choice(["ch5", "ch6"])), "discipline": discipline}
    if discipline in ("newest-waits", "fcfs", "lcfs-preempt") and rng.random() < 0.5:
        channel["server"] = {"shared": True}
    if discipline in ("fcfs", "parallel"):
        channel["queue_limit"] = QUEUE_LIMIT
    faults = {"loss": 0.1, "duplication": 0.1, "corruption": 0.1, "reset": {"at_ms": [900.0]}}
    channel["faults"] = {name: about for name, about in faults.items() if rng.random() < 0.4}
    name, value = parse_policy(str(rng.choice(POLICIES)))
    edge = {"field": "splat", "field_options": _SMALL, "updates": "cycle", "policy": {"name": name, "value": value}}
    return parse(
        {
            "name": f"chaos-{seed}",
            "seed": seed,
            "cameras": {"count": 5, "held_out": ["cam00"], "phase": str(rng.choice(["locked", "spread"]))},
            # With its own motion, its frames, which no other seed needs, are not kept on disk.
            "source": small_world(motion_seed=seed),
            "channel": channel,
            "edge": edge,
        },
        Path(f"chaos-{seed}.yaml"),
    )


def draw_faults(seed: int, cameras: tuple[str, ...]) -> tuple[Fault, ...]:
    """Three to ten faults, in the order of their instants."""
    rng = np.random.default_rng(seed_sequence(seed, "chaos", "faults"))
    instants = np.sort(rng.uniform(*_FAULTS_BEGIN_S, rng.integers(3, 11)) * 1e3)
    return tuple(_draw(rng, k, float(at_ms), cameras) for k, at_ms in enumerate(instants))


def _draw(rng: np.random.Generator, number: int, at_ms: float, cameras: tuple[str, ...]) -> Fault:
    kinds = ["crash", "stall", "away", "clock_step", "policy", "checkpoint"]
    kind, value, target = str(rng.choice(kinds)), 0.0, ""
    for_ms = float(rng.uniform(20.0, 1e3 * (FAULTS_OVER_S - _FAULTS_BEGIN_S[1])))
    if kind in ("crash", "stall"):
        target, value = str(rng.choice(ROLES)), float(kind == "crash" and rng.random() < 0.7)
    elif kind in ("away", "clock_step"):
        target = str(rng.choice(cameras))
        value = round(float(rng.uniform(-500.0, 500.0)), 3) if kind == "clock_step" else 0.0
    elif kind == "policy":
        target = str(rng.choice(POLICIES))
    lasts = kind in ("crash", "stall", "away")
    return Fault(number, kind, at_ms, for_ms if lasts else 0.0, target, value)
