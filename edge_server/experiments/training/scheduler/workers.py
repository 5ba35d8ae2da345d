"""Evaluates episodes in processes of one thread each. A result depends only on the request, not on the number
of processes or on their order.

An episode belongs to one process, which keeps its images and its warm field, so all actions of its decisions
are evaluated there. A known evaluation is not repeated; with a file, not even in a later run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.result_store import ResultStore, content_key
from edge_server.experiments.common.source_digest import source_digest
from edge_server.experiments.common.worker import WorkerContext, end_at_once, init_worker
from edge_server.experiments.training.scheduler.deployed import Decided, Judged, judge, play
from edge_server.experiments.training.scheduler.episode import Choice, DecisionPoint, EpisodeFactory, Outcome
from edge_server.experiments.training.scheduler.setting import Setting
from edge_server.scheduler.learned.actor import Actor

Request = tuple[int, int, Choice]
"""What to evaluate: seed of an episode, number of a decision, choice."""
Progress = Callable[[int, int], None]
_Task = tuple[list[str], list[Request]]

# Number of evaluations of one task: few, so that Ctrl-C loses little and progress is reported.
_REQUESTS_A_TASK = 8
# Number of settings whose images a process keeps.
_FACTORIES_KEPT = 3
_FACTORIES: dict[tuple[str, Folders], EpisodeFactory] = {}


def _factory(setting: Setting, folders: Folders) -> EpisodeFactory:
    at = (setting.key, folders)
    if at not in _FACTORIES:
        while len(_FACTORIES) >= _FACTORIES_KEPT:
            _FACTORIES.pop(next(iter(_FACTORIES)))
        _FACTORIES[at] = EpisodeFactory(setting, folders)
    return _FACTORIES[at]


def _draw(setting: Setting, folders: Folders, seeds: Sequence[int]) -> list[tuple[DecisionPoint, ...]]:
    factory = _factory(setting, folders)
    return [factory.episode(seed).moments for seed in seeds]


def _evaluate(setting: Setting, folders: Folders, requests: Sequence[Request]) -> list[tuple[Outcome, float]]:
    """Outcomes, and the milliseconds of processor time that each took."""
    factory, found = _factory(setting, folders), []
    for seed, number, choice in requests:
        episode = factory.episode(seed)
        before_s = episode.spent_s
        outcome = episode.evaluate(number, choice)
        found.append((outcome, round((episode.spent_s - before_s) * 1e3, 3)))
    return found


def _each(work: Callable[..., Any], setting: Setting, folders: Folders, asked: Sequence[Any]) -> list[Any]:
    """Call ``work`` with the setting's factory and each tuple of further arguments."""
    return [work(_factory(setting, folders), *one) for one in asked]


def _init_process() -> None:
    """Initializer of a worker process: one thread."""
    init_worker(threads=1)
    import torch

    # The number of threads that share a convolution changes its last bits.
    torch.set_num_threads(1)


class WorkerPool:
    """Draws and evaluates decisions. Use as a context, or ``close`` at the end.

    jobs: number of processes; 1 evaluates in this one.
    known: file of evaluations that is read and appended to; None keeps them in memory only.
    """

    def __init__(self, folders: Folders, jobs: int = 1, known: Path | None = None) -> None:
        self.folders, self.jobs = folders, max(1, jobs)
        self.evaluated = 0
        """Number of evaluations that were carried out, not found in the file."""
        self._pools: list[ProcessPoolExecutor] = []
        self._moments: dict[tuple[str, int], tuple[DecisionPoint, ...]] = {}
        self._store = ResultStore() if known is None else ResultStore.in_lines(known)
        self._known: dict[str, tuple[Outcome, float]] = {}
        """Outcome and milliseconds of processor time by key."""
        for key, found in self._store.results.items():
            try:
                cost_ms = float(found["cost_ms"])
                outcome = Outcome(**{name: v for name, v in found.items() if name != "cost_ms"})
            except (ValueError, KeyError, TypeError):
                continue  # written by another version
            self._known[key] = outcome, cost_ms

    def __enter__(self) -> WorkerPool:
        return self

    def __exit__(self, *error: object) -> None:
        self.close(at_once=error[0] is not None)

    def close(self, at_once: bool = False) -> None:
        """End the processes. at_once: do not wait for what they are doing."""
        pools, self._pools = self._pools, []
        for pool in pools:
            if at_once:
                end_at_once(pool)
            else:
                pool.shutdown()
        self._store.close()

    def draw(self, setting: Setting, seeds: Sequence[int]) -> list[tuple[DecisionPoint, ...]]:
        """The decisions of each episode, in the order of the seeds."""
        missing = [seed for seed in seeds if (setting.key, seed) not in self._moments]
        parts = [[s for s in missing if s % self.jobs == place] for place in range(self.jobs)]
        sent = [(part, self._send(part[0], _draw, setting, part)) for part in parts if part]
        for part, result in sent:
            for seed, moments in zip(part, result.result()):
                self._moments[setting.key, seed] = moments
        return [self._moments[setting.key, seed] for seed in seeds]

    def forget(self, setting: Setting, seeds: Sequence[int]) -> None:
        """Free the memory of episodes that are not needed any more."""
        for seed in seeds:
            self._moments.pop((setting.key, seed), None)

    def evaluate(self, setting: Setting, requests: Sequence[Request], say: Progress | None = None) -> list[Outcome]:
        """The outcome of each request, in order. After Ctrl-C the file has what was finished.

        say: called with the number of new evaluations that are done and their total.
        """
        keys = [self._key(setting, r) for r in requests]
        wanted = {key: r for key, r in zip(keys, requests) if key not in self._known}
        tasks: list[_Task] = []
        for place in range(self.jobs):
            mine = [(key, r) for key, r in wanted.items() if r[0] % self.jobs == place]
            for i in range(0, len(mine), _REQUESTS_A_TASK):
                part = mine[i : i + _REQUESTS_A_TASK]
                tasks.append(([key for key, _ in part], [r for _, r in part]))
        done = 0
        for names, found in self._results(setting, tasks):
            for name, (outcome, cost_ms) in zip(names, found):
                self._known[name] = outcome, cost_ms
                self.evaluated += 1
                self._store.put(name, result={"cost_ms": cost_ms, **asdict(outcome)})
            done += len(names)
            if say is not None:
                say(done, len(wanted))
        return [self._known[key][0] for key in keys]

    def cost_s(self, setting: Setting, requests: Sequence[Request]) -> float:
        """Seconds of processor time of evaluated requests: episodes, warm fields, fits and scores. Each
        counts once, with the time that it took when it was carried out. Raises KeyError for an unknown
        one."""
        return math.fsum(self._known[key][1] for key in {self._key(setting, r) for r in requests}) / 1e3

    def play(self, setting: Setting, seeds: Sequence[int], actor: Actor, tries: int) -> list[list[list[Decided]]]:
        """The decisions of every try of each episode in which ``actor`` decides."""
        work = partial(_each, play)
        sent = [self._send(s, work, setting, [(s, actor, turn) for turn in range(tries)]) for s in seeds]
        return [one.result() for one in sent]

    def judge(self, setting: Setting, seeds: Sequence[int], who: Judged) -> Iterator[dict[str, Any]]:
        """``deployed.judge`` of each episode."""
        sent: Iterable[Future[list[Any]]] = (self._send(s, partial(_each, judge), setting, [(s, who)]) for s in seeds)
        # With one job, sending computes the result, so send one only when it is asked for.
        for one in sent if self.jobs == 1 else list(sent):
            yield one.result()[0]

    def _results(self, setting: Setting, tasks: Sequence[_Task]) -> Iterator[tuple[list[str], list[Any]]]:
        """Keys and results of the tasks, as they finish."""
        if self.jobs == 1:
            for names, part in tasks:
                yield names, _evaluate(setting, self.folders, part)
            return
        sent = {self._send(part[0][0], _evaluate, setting, part): names for names, part in tasks}
        for result in as_completed(sent):
            yield sent[result], result.result()

    def _send(
        self, seed: int, work: Callable[..., list[Any]], setting: Setting, what: Sequence[Any]
    ) -> Future[list[Any]]:
        """Submit work to the process that an episode belongs to."""
        if self.jobs == 1:
            done: Future[list[Any]] = Future()
            done.set_result(work(setting, self.folders, what))
            return done
        if not self._pools:
            # Spawned processes: a fork of a process that has kernel threads would hang.
            self._pools = [ProcessPoolExecutor(1, WorkerContext(), _init_process) for _ in range(self.jobs)]
        return self._pools[seed % self.jobs].submit(work, setting, self.folders, what)

    def _key(self, setting: Setting, request: Request) -> str:
        seed, number, choice = request
        lpips = self.folders.lpips
        weights = "" if lpips is None else str(sorted(p.name for p in lpips.glob("*.npz")))
        return content_key([source_digest(), setting.key, weights, seed, number, asdict(choice)], 32)
