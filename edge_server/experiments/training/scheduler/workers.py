"""Carries out episodes in processes of one thread each. What comes back depends on what was asked for and on
nothing else: neither on how many processes there are nor on who was first.

An episode belongs to one process, which keeps its pictures and its warm field, so that all actions of its
decisions are evaluated there. What is known is not evaluated again; with a file, not even by the next run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from edge_server.experiments.common.result_store import ResultStore, content_key
from edge_server.experiments.common.worker import init_worker
from edge_server.experiments.studies.engine import source_digest
from edge_server.experiments.studies.trial import Folders
from edge_server.experiments.training.scheduler.episode import Choice, DecisionPoint, EpisodeFactory, Outcome
from edge_server.experiments.training.scheduler.setting import Setting

Asked = tuple[int, int, Choice]
"""Seed of an episode, number of a decision, what was chosen."""
Progress = Callable[[int, int], None]
_Task = tuple[list[str], list[Asked]]

# Evaluations of one task: few enough that little is lost by Ctrl-C, and that progress can be told.
_ASKED_A_TASK = 8
# Settings whose pictures a process keeps.
_GROUNDS_KEPT = 3
_FACTORIES: dict[tuple[str, Folders], EpisodeFactory] = {}


def _factory(setting: Setting, folders: Folders) -> EpisodeFactory:
    at = (setting.key, folders)
    if at not in _FACTORIES:
        while len(_FACTORIES) >= _GROUNDS_KEPT:
            _FACTORIES.pop(next(iter(_FACTORIES)))
        _FACTORIES[at] = EpisodeFactory(setting, folders)
    return _FACTORIES[at]


def _draw(setting: Setting, folders: Folders, seeds: Sequence[int]) -> list[tuple[DecisionPoint, ...]]:
    factory = _factory(setting, folders)
    return [factory.episode(seed).moments for seed in seeds]


def _evaluate(setting: Setting, folders: Folders, asked: Sequence[Asked]) -> list[tuple[Outcome, float]]:
    """Outcomes, and the milliseconds of processor time that each took."""
    factory, found = _factory(setting, folders), []
    for seed, number, choice in asked:
        episode = factory.episode(seed)
        before_s = episode.spent_s
        outcome = episode.evaluate(number, choice)
        found.append((outcome, round((episode.spent_s - before_s) * 1e3, 3)))
    return found


def _begin() -> None:
    """In a process of the crew: one thread."""
    init_worker(threads=1)
    import torch

    # How many threads share a convolution decides its last bits.
    torch.set_num_threads(1)


class WorkerPool:
    """jobs: processes; 1 does everything in this one. known: file of evaluations that is read and added to;
    None keeps them in memory only. Use as a context, or ``close`` at the end."""

    def __init__(self, folders: Folders, jobs: int = 1, known: Path | None = None) -> None:
        self.folders, self.jobs = folders, max(1, jobs)
        self.evaluated = 0
        """Evaluations that were carried out, not found."""
        self._pools: list[ProcessPoolExecutor] = []
        self._moments: dict[tuple[str, int], tuple[DecisionPoint, ...]] = {}
        self._store = ResultStore() if known is None else ResultStore.in_lines(known)
        self._known: dict[str, Outcome] = {}
        self._cost_ms: dict[str, float] = {}
        for key, found in self._store.results.items():
            try:
                cost_ms = float(found["cost_ms"])
                self._known[key] = Outcome(**{name: v for name, v in found.items() if name != "cost_ms"})
                self._cost_ms[key] = cost_ms
            except (ValueError, KeyError, TypeError):
                continue  # of another version

    def __enter__(self) -> WorkerPool:
        return self

    def __exit__(self, *error: object) -> None:
        self.close(at_once=error[0] is not None)

    def close(self, at_once: bool = False) -> None:
        """End the processes; at_once: without waiting for what they are doing."""
        pools, self._pools = self._pools, []
        for pool in pools:
            if at_once:
                for process in list((pool._processes or {}).values()):
                    process.terminate()
            pool.shutdown(wait=not at_once, cancel_futures=at_once)
        self._store.close()

    def draw(self, setting: Setting, seeds: Sequence[int]) -> list[tuple[DecisionPoint, ...]]:
        """The decisions of each episode, in the order of the seeds."""
        found = [self._moments.get((setting.key, seed)) for seed in seeds]
        for seed, moments in zip(*self._drawn(setting, [s for s, m in zip(seeds, found) if m is None])):
            self._moments[setting.key, seed] = moments
        return [self._moments[setting.key, seed] for seed in seeds]

    def forget(self, setting: Setting, seeds: Sequence[int]) -> None:
        """Give back the memory of episodes that are not needed any more."""
        for seed in seeds:
            self._moments.pop((setting.key, seed), None)

    def evaluate(
        self, setting: Setting, asked: Sequence[Asked], say: Progress | None = None
    ) -> list[Outcome]:
        """What each choice came to, in the order asked. After Ctrl-C the file has what was finished. say: is
        told how many of the evaluations that were not known are done, and how many there are."""
        keys = [self._key(setting, a) for a in asked]
        wanted = {key: a for key, a in zip(keys, asked) if key not in self._known}
        tasks: list[_Task] = []
        for place in range(self.jobs):
            mine = [(key, a) for key, a in wanted.items() if a[0] % self.jobs == place]
            for i in range(0, len(mine), _ASKED_A_TASK):
                part = mine[i : i + _ASKED_A_TASK]
                tasks.append(([key for key, _ in part], [a for _, a in part]))
        done = 0
        for names, found in self._carried_out(setting, tasks):
            for name, (outcome, cost_ms) in zip(names, found):
                self._known[name], self._cost_ms[name] = outcome, cost_ms
                self.evaluated += 1
                self._store.put(name, result={"cost_ms": cost_ms, **asdict(outcome)})
            done += len(names)
            if say is not None:
                say(done, len(wanted))
        return [self._known[key] for key in keys]

    def cost_s(self, setting: Setting, asked: Sequence[Asked]) -> float:
        """Processor time of what has been evaluated, episodes, warm fields, fits and scores, each evaluation
        counted once and as what it took when it was carried out, however long ago. KeyError where one has not
        been."""
        return math.fsum(self._cost_ms[key] for key in {self._key(setting, a) for a in asked}) / 1e3

    def _carried_out(self, setting: Setting, tasks: Sequence[_Task]) -> Iterator[tuple[list[str], list[Any]]]:
        """Tasks as they are finished."""
        if self.jobs == 1:
            for names, part in tasks:
                yield names, _evaluate(setting, self.folders, part)
            return
        sent = {self._send(part[0][0], _evaluate, setting, part): names for names, part in tasks}
        for result in as_completed(sent):
            yield sent[result], result.result()

    def _drawn(
        self, setting: Setting, seeds: Sequence[int]
    ) -> tuple[list[int], list[tuple[DecisionPoint, ...]]]:
        parts = [[s for s in seeds if s % self.jobs == place] for place in range(self.jobs)]
        sent = [(part, self._send(part[0], _draw, setting, part)) for part in parts if part]
        order = [seed for part, _ in sent for seed in part]
        return order, [moments for _, result in sent for moments in result.result()]

    def _send(
        self, seed: int, work: Callable[..., list[Any]], setting: Setting, what: Sequence[Any]
    ) -> Future[list[Any]]:
        """Have the process that an episode belongs to do something."""
        if self.jobs == 1:
            done: Future[list[Any]] = Future()
            done.set_result(work(setting, self.folders, what))
            return done
        if not self._pools:
            # Fresh processes: forking one that has threads of kernels in it would hang.
            context = get_context("spawn")
            self._pools = [ProcessPoolExecutor(1, context, _begin) for _ in range(self.jobs)]
        return self._pools[seed % self.jobs].submit(work, setting, self.folders, what)

    def _key(self, setting: Setting, asked: Asked) -> str:
        seed, number, choice = asked
        parts = [source_digest(), setting.key, self._weights, seed, number, asdict(choice)]
        return content_key(parts, 32)

    @property
    def _weights(self) -> str:
        return (
            ""
            if self.folders.lpips is None
            else str(sorted(p.name for p in self.folders.lpips.glob("*.npz")))
        )
