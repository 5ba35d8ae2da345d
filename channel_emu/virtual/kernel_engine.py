"""The engine ``kernel`` of ``simulate``: runs the compiled kernels for all cameras.

Cameras with their own servers do not interact: each is one task of a thread pool (the kernels release the
GIL), and results do not depend on the number of threads. A shared server is one task.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from channel_emu.model.chain import Chain
from channel_emu.model.channel import Channel
from channel_emu.model.config import LAWS, ChannelConfig
from channel_emu.model.counter_rng import stream_key
from channel_emu.model.faults import per_state
from channel_emu.model.link import DISCIPLINES
from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.virtual.kernels import chain_path, philox, service, work
from channel_emu.virtual.link_run import OUTCOME_CODES, LinkRun, camera_period_ms, name_ranks
from freshfield.machine_load import usable_cores

# Below this virtual time of all cameras together, a thread pool costs more than it saves.
_MIN_THREADED_NS = 300 * 10**9

Path = tuple[NDArray[np.int64], NDArray[np.int64]]
# Instants at which frames are offered, and at which they arrive at the server (-1: never sampled).
Offers = tuple[NDArray[np.int64], NDArray[np.int64]]
Prepared = tuple[Path, Offers]

# numba's signatures say nothing that a type checker could use.
_serve: Any = service.serve


def run(
    config: ChannelConfig,
    channel: Channel,
    names: list[str],
    end_ns: int,
    frame_period_ms: float | None,
    threads: int | None = None,
) -> list[LinkRun]:
    """Every camera's run, in the order of ``names``. Arguments as in ``simulate.simulate``."""
    if threads is None:
        threads = usable_cores() if end_ns * len(names) >= _MIN_THREADED_NS else 1
    shared_path = _path(channel.chain, "", channel.seed, end_ns) if channel.chain else None
    jobs = [
        partial(_prepare, config, channel, name, rank / len(names), end_ns, frame_period_ms, shared_path)
        for name, rank in zip(names, name_ranks(names))
    ]
    if config.server.shared:
        return _serve_together(config, channel, names, _run_jobs(jobs, threads), end_ns)
    alone = [partial(_serve_alone, config, channel, name, job, end_ns) for name, job in zip(names, jobs)]
    return _run_jobs(alone, threads)


def _run_jobs(jobs: Sequence[Callable[[], Any]], threads: int) -> list[Any]:
    if threads <= 1 or len(jobs) == 1:
        return [job() for job in jobs]
    with ThreadPoolExecutor(min(threads, len(jobs))) as pool:
        return [result.result() for result in [pool.submit(job) for job in jobs]]


def _prepare(
    config: ChannelConfig,
    channel: Channel,
    name: str,
    phase: float,
    end_ns: int,
    frame_period_ms: float | None,
    shared_path: Path | None,
) -> Prepared:
    """A camera's chain path and its offers, which do not depend on other cameras."""
    camera_path = shared_path or _path(channel.chain_of(name), name, channel.seed, end_ns)
    poisson = config.arrivals.process == "poisson"
    rates = np.array([r / 1e6 for r in per_state(config.arrivals.rate_per_ms or 0.0)])
    key = _key(channel.seed, name, "channel.arrivals")
    if poisson and frame_period_ms is None:
        offered = chain_path.poisson_arrivals(rates, *camera_path, key, end_ns)
        return camera_path, (offered, offered)
    period_ms = camera_period_ms(config, frame_period_ms)
    phase_ns = round(phase * period_ms * 1e6) if config.arrivals.spread else 0
    offered = np.arange(phase_ns, end_ns + 1, round(period_ms * 1e6), dtype=np.int64)
    return camera_path, (offered, chain_path.sample_newest(offered, rates, *camera_path, key) if poisson else offered)


def _serve_alone(
    config: ChannelConfig, channel: Channel, name: str, prepare: Callable[[], Prepared], end_ns: int
) -> LinkRun:
    path, (offered, arrive) = prepare()
    outcome, started, due = _serve(
        arrive,
        np.zeros(len(arrive), np.int64),
        DISCIPLINES.index(config.discipline),
        config.queue_limit,
        _work(config, channel, name, len(arrive)),
        *_service_means(config),
        *path,
        np.zeros(1, np.int64),
        np.array([len(path[0])]),
        end_ns,
    )
    return _run_of(config, channel, name, path, (offered, outcome, started, due), end_ns)


def _serve_together(
    config: ChannelConfig, channel: Channel, names: list[str], prepared: list[Prepared], end_ns: int
) -> list[LinkRun]:
    """The runs of cameras that share one server."""
    by_rank = np.argsort(name_ranks(names))
    offers = [prepared[i][1] for i in by_rank]
    camera = np.repeat(np.arange(len(names)), [len(o[0]) for o in offers])
    drawn = np.concatenate([_work(config, channel, names[i], len(o[0])) for i, o in zip(by_rank, offers)])
    offered = np.concatenate([o[0] for o in offers])
    arrive = np.concatenate([o[1] for o in offers])
    order = np.lexsort((camera, offered, arrive))
    order = order[arrive[order] >= 0]
    paths = [prepared[i][0] for i in by_rank]
    one_path = channel.chain is not None or config.chain is None
    lengths = [len(paths[0][0])] if one_path else [len(p[0]) for p in paths]
    ends = np.cumsum(lengths)
    pick = np.zeros(len(names), np.int64) if one_path else np.arange(len(names))
    kept = paths[:1] if one_path else paths
    outcome = np.full(len(arrive), service.SKIPPED, np.int8)
    started, due = np.full(len(arrive), -1, np.int64), np.full(len(arrive), -1, np.int64)
    outcome[order], started[order], due[order] = _serve(
        arrive[order],
        camera[order],
        DISCIPLINES.index(config.discipline),
        config.queue_limit,
        drawn[order],
        *_service_means(config),
        np.concatenate([p[0] for p in kept]),
        np.concatenate([np.append(p[1], 0) for p in kept]),
        (ends - lengths)[pick],
        ends[pick],
        end_ns,
    )
    runs: dict[int, LinkRun] = {}
    for rank, i in enumerate(by_rank):
        mine = camera == rank
        frames = (offered[mine], outcome[mine], started[mine], due[mine])
        runs[int(i)] = _run_of(config, channel, names[i], paths[rank], frames, end_ns)
    return [runs[i] for i in range(len(names))]


def _run_of(
    config: ChannelConfig, channel: Channel, name: str, path: Path, frames: tuple[Any, ...], end_ns: int
) -> LinkRun:
    """Apply the loss fault and make the result.

    frames: offered_ns, outcome, started_ns and due_ns of a ``LinkRun``, before losses.
    """
    offered, outcome, started, due = frames
    starts, states = path
    if loss := config.faults.get("loss"):
        uniform, other = np.empty(len(offered)), np.empty(len(offered))
        philox.fill(0, uniform, other, _key(channel.seed, name, "channel.loss"))
        chance = np.array(per_state(loss.probability))
        if len(chance) > 1:
            chance = chance[states[np.searchsorted(starts[:-1], np.maximum(started, 0), side="right") - 1]]
        outcome[(outcome == service.DELIVERED) & (uniform < chance)] = OUTCOME_CODES["lost"]
    spent_ns = np.bincount(states, np.diff(np.minimum(starts, end_ns)), len(config.state_names))
    return LinkRun(name, offered, outcome, started, due, end_ns, [float(ns) / end_ns for ns in spent_ns])


def _work(config: ChannelConfig, channel: Channel, name: str, count: int) -> NDArray[np.float64]:
    law = config.service
    parameter = float(law.shape or law.sigma or 0.0)
    delays_ms = np.array(law.delays_ms or [0.0])
    key = _key(channel.seed, name, "channel.service")
    return work.draw(count, LAWS.index(law.law), parameter, delays_ms, key)


def _service_means(config: ChannelConfig) -> tuple[NDArray[np.float64], NDArray[np.float64], bool]:
    """means_ms, speeds and modulated, as the kernels take them."""
    means_ms = np.array(per_state(1.0 if config.service.mean_ms is None else config.service.mean_ms), float)
    with np.errstate(divide="ignore"):
        speeds = 1.0 / (means_ms * 1e6)
    return means_ms, speeds, config.service_state == "modulated" and len(means_ms) > 1


def _path(chain: Chain | None, camera: str, seed: int, end_ns: int) -> Path:
    if chain is None:
        return np.array([0, NEVER_NS], np.int64), np.zeros(1, np.int64)
    key = _key(seed, camera, "channel.chain")
    return chain_path.chain_path(chain.sojourn_rate, chain.jumps, chain.slot_ns, key, chain.initial, end_ns)


def _key(seed: int, camera: str, purpose: str) -> NDArray[np.uint64]:
    return np.array(stream_key(seed, camera, purpose), np.uint64)
