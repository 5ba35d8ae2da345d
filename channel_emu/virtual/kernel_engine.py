"""Runs the kernels for whole deployments: what ``simulate`` does with ``engine="kernel"``.

Cameras with a line of their own do not meet, so each is one task for a pool of threads (the kernels let go of
the interpreter's lock), and the result is the same whatever their number. A shared line is one task.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from channel_emu.model.chain import Chain
from channel_emu.model.channel import Channel
from channel_emu.model.config import ChannelConfig, per_state
from channel_emu.model.counter_rng import stream_key
from channel_emu.model.instants import NEVER_NS
from channel_emu.model.link import DISCIPLINES
from channel_emu.model.queue_server import ORDERS
from channel_emu.virtual.kernels import chain_path as path
from channel_emu.virtual.kernels import link_service, shared_service, work
from channel_emu.virtual.simulate import LinkRun, period_ms, ranks

_LAWS = ("none", "exponential", "deterministic", "gamma", "lognormal", "trace")
# Of virtual time, all cameras together: below this a pool of threads costs more than it saves.
_WORTH_THREADS_NS = 300 * 10**9

Path = tuple[NDArray[np.int64], NDArray[np.int64]]
# When frames are offered, and when they arrive at the link (-1: never sampled).
Offers = tuple[NDArray[np.int64], NDArray[np.int64]]
Prepared = tuple[Path, Offers]

# numba's signatures say nothing that a type checker could use.
_serve: Any = link_service.serve
_share: Any = shared_service.serve_shared


def run(
    config: ChannelConfig,
    channel: Channel,
    names: list[str],
    end_ns: int,
    frame_period_ms: float | None,
    threads: int | None = None,
) -> list[LinkRun]:
    """Every camera's run, in the order of ``names``; the arguments are ``simulate.simulate``'s."""
    if threads is None:
        threads = _processors() if end_ns * len(names) >= _WORTH_THREADS_NS else 1
    common = _path(channel.chain, "", channel.seed, end_ns) if channel.chain else None
    jobs = [
        partial(_prepare, config, channel, name, turn / len(names), end_ns, frame_period_ms, common)
        for name, turn in zip(names, ranks(names))
    ]
    if config.server.shared:
        return _serve_shared(config, channel, names, _each(jobs, threads), end_ns)
    return _each([partial(_serve_one, config, channel, name, job, end_ns) for name, job in zip(names, jobs)],
                 threads)  # fmt: skip


def _each(jobs: Sequence[Callable[[], Any]], threads: int) -> list[Any]:
    if threads <= 1 or len(jobs) == 1:
        return [job() for job in jobs]
    with ThreadPoolExecutor(min(threads, len(jobs))) as pool:
        return [result.result() for result in [pool.submit(job) for job in jobs]]


def _prepare(
    config: ChannelConfig,
    channel: Channel,
    name: str,
    turn: float,
    end_ns: int,
    frame_period_ms: float | None,
    common: Path | None,
) -> Prepared:
    """A camera's chain and when its frames come; nothing of this depends on other cameras' frames."""
    along = common or _path(channel.chain_of(name), name, channel.seed, end_ns)
    poisson = config.arrivals.process == "poisson"
    rates = np.array([r / 1e6 for r in per_state(config.arrivals.rate_per_ms or 0.0)])
    key = _key(channel.seed, name, "channel.arrivals")
    if poisson and frame_period_ms is None:
        offered = path.poisson_arrivals(rates, *along, key, end_ns)
        return along, (offered, offered)
    every_ms = period_ms(config, frame_period_ms)
    phase_ns = round(turn * every_ms * 1e6) if config.arrivals.spread else 0
    offered = np.arange(phase_ns, end_ns + 1, round(every_ms * 1e6), dtype=np.int64)
    return along, (offered, path.sample_newest(offered, rates, *along, key) if poisson else offered)


def _serve_one(
    config: ChannelConfig, channel: Channel, name: str, prepare: Callable[[], Prepared], end_ns: int
) -> LinkRun:
    along, (offered, arrive) = prepare()
    outcome, started, due = _serve(
        arrive, DISCIPLINES.index(config.discipline), config.queue_limit,
        _work(config, channel, name, len(arrive)), *_means(config), *along, end_ns,
    )  # fmt: skip
    return LinkRun(name, offered, outcome, started, due, end_ns, _shares(config, along, end_ns))


def _serve_shared(
    config: ChannelConfig, channel: Channel, names: list[str], prepared: list[Prepared], end_ns: int
) -> list[LinkRun]:
    by_rank = np.argsort(ranks(names))
    offers = [prepared[i][1] for i in by_rank]
    camera = np.concatenate([np.full(len(o[0]), rank, np.int64) for rank, o in enumerate(offers)])
    drawn = np.concatenate([_work(config, channel, names[i], len(o[0])) for i, o in zip(by_rank, offers)])
    offered = np.concatenate([o[0] for o in offers])
    arrive = np.concatenate([o[1] for o in offers])
    order = np.lexsort((camera, offered, arrive))
    order = order[arrive[order] >= 0]
    paths = [prepared[i][0] for i in by_rank]
    alike = channel.chain is not None or config.chain is None
    lengths = [len(paths[0][0])] if alike else [len(p[0]) for p in paths]
    ends = np.cumsum(lengths)
    pick = np.zeros(len(names), np.int64) if alike else np.arange(len(names))
    kept = paths[:1] if alike else paths
    outcome = np.full(len(arrive), link_service.SKIPPED, np.int8)
    started, due = np.full(len(arrive), -1, np.int64), np.full(len(arrive), -1, np.int64)
    outcome[order], started[order], due[order] = _share(
        arrive[order], offered[order], camera[order], DISCIPLINES.index(config.discipline),
        ORDERS.index(config.server.order), config.queue_limit, drawn[order], *_means(config),
        np.concatenate([p[0] for p in kept]), np.concatenate([np.append(p[1], 0) for p in kept]),
        (ends - lengths)[pick], ends[pick], end_ns,
    )  # fmt: skip
    runs: dict[int, LinkRun] = {}
    for rank, i in enumerate(by_rank):
        mine = camera == rank
        runs[int(i)] = LinkRun(
            names[i], offered[mine], outcome[mine], started[mine], due[mine], end_ns,
            _shares(config, paths[rank], end_ns),
        )  # fmt: skip
    return [runs[i] for i in range(len(names))]


def _work(config: ChannelConfig, channel: Channel, name: str, count: int) -> NDArray[np.float64]:
    service = config.service
    parameter = float(service.shape or service.sigma or 0.0)
    delays_ms = np.array(service.delays_ms or [0.0])
    key = _key(channel.seed, name, "channel.service")
    return work.draw(count, _LAWS.index(service.law), parameter, delays_ms, key)


def _means(config: ChannelConfig) -> tuple[NDArray[np.float64], bool]:
    """means_ms and modulated, as the kernels take them."""
    means_ms = per_state(config.service.mean_ms) if config.service.mean_ms is not None else [1.0]
    return np.array(means_ms, float), config.service_state == "modulated" and len(means_ms) > 1


def _shares(config: ChannelConfig, along: Path, end_ns: int) -> list[float]:
    starts, states = along
    spent_ns = np.bincount(states, np.diff(np.minimum(starts, end_ns)), len(config.state_names))
    return [float(ns) / end_ns for ns in spent_ns]


def _path(chain: Chain | None, camera: str, seed: int, end_ns: int) -> Path:
    if chain is None:
        return np.array([0, NEVER_NS], np.int64), np.zeros(1, np.int64)
    key = _key(seed, camera, "channel.chain")
    return path.chain_path(chain.pace, chain.jumps, chain.slot_ns, key, chain.initial, end_ns)


def _key(seed: int, camera: str, purpose: str) -> NDArray[np.uint64]:
    return np.array(stream_key(seed, camera, purpose), np.uint64)


def _processors() -> int:
    known = getattr(os, "sched_getaffinity", None)
    return len(known(0)) if known else os.cpu_count() or 1
