"""Measures the time of a learned decision, from the newest frames to the action, and of its parts.

Embeddings are given; ``bench embed`` measures their cost.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.experiments.bench.run import BenchRun
from edge_server.scheduler import STATE_PARTS, Epoch
from edge_server.scheduler.learned import networks
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.bandit import BanditPolicy
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.observation import observe
from edge_server.scheduler.learned.state import State, StateLayout
from freshfield.frame import BufferedFrame, Frame
from freshfield.geometry import Pinhole, Pose, look_at
from freshfield.machine_load import LoadMeter

CAMERAS = (18, 200)
DIM = 64
OMEGAS_MS = tuple(float(omega) for omega in range(0, 301, 20))
_LENS = Pinhole.from_fov(64, 64, 60.0)


def measure(run: BenchRun) -> dict[str, Any]:
    """Milliseconds of decisions, median and 99th percentile, by kind of action and number of cameras."""
    repeats = 200 if run.quick else 2000
    load = LoadMeter()
    found = {f"{action}, {n} cameras": _decision(action, n, repeats) for n in CAMERAS for action in ("select", "wait")}
    return {"embedding_dim": DIM, **found, "outside_cores": load.outside_cores()}


def _decision(action: Any, n: int, repeats: int) -> dict[str, float]:
    spec = Spec(action, StateLayout(dim=DIM), () if action == "select" else OMEGAS_MS)
    policy = BanditPolicy(
        Actor(spec, networks.init_actor(spec, np.random.default_rng(0))), "bandit", np.random.default_rng(1)
    )
    newest, embeddings = _newest_frames(n), _StoredEmbeddings(n)
    names = tuple(newest)
    generated = {c: item.generated_ns for c, item in newest.items()}
    at = [0]

    def state(parts: Sequence[str] = STATE_PARTS) -> State:
        return observe(names, newest, at[0], embeddings, parts)

    def decide() -> None:
        at[0] += 10_000_000
        epoch = Epoch(at[0], 0, generated, state)
        plan = policy.plan(epoch)
        policy.select(epoch, plan)

    whole, features = state(), spec.layout.batch([state()])
    tasks = {
        "decision": decide,
        "state": lambda: spec.layout.features(state(spec.layout.parts)),
        "network": lambda: policy.actor.logits(features),
        "action": lambda: policy.actor.act([whole]),
    }
    return {name: value for part, task in tasks.items() for name, value in _ms(part, task, repeats).items()}


def _ms(part: str, task: Callable[[], Any], repeats: int) -> dict[str, float]:
    """Wall-clock time of ``task``, and processor time of this thread, which other processes do not
    increase."""
    for _ in range(20):  # libraries load and allocate at the first calls
        task()
    gc.collect()
    spent: list[tuple[float, float]] = []
    for _ in range(repeats):
        began, cpu_began = time.perf_counter(), time.thread_time()
        task()
        spent.append((time.perf_counter() - began, time.thread_time() - cpu_began))
    wall_ms, cpu_ms = 1e3 * np.array(spent).T
    return {
        f"{part}_ms_p50": float(np.median(wall_ms)),
        f"{part}_ms_p99": float(np.percentile(wall_ms, 99)),
        f"{part}_cpu_ms_p99": float(np.percentile(cpu_ms, 99)),
    }


def _newest_frames(n: int) -> dict[str, BufferedFrame]:
    """The newest frames of ``n`` cameras in a circle; no decision decodes them."""
    found = {}
    for i in range(n):
        angle = 2.0 * np.pi * i / n
        pose = Pose.from_matrix(look_at([3.0 * np.cos(angle), 3.0 * np.sin(angle), 1.5], [0.0, 0.0, 0.0]))
        frame = Frame(f"cam{i:03d}", "bench", 0, i * 1_000_000, pose, _LENS, "jpeg", b"")
        found[frame.camera] = BufferedFrame(frame, frame.generated_ns, 0)
    return found


class _StoredEmbeddings:
    """Embeddings that are already computed."""

    def __init__(self, n: int) -> None:
        self._rows = np.random.default_rng(1).standard_normal((n, DIM)).astype(np.float32)

    def of(self, items: Any) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        return self._rows[: len(items)], np.ones(len(items), bool)
