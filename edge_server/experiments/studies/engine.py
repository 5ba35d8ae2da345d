"""Runs trials without stored results: serially, in local processes, or on a Ray cluster.

A trial's result depends only on the trial, not on the backend or order; a test compares the three backends.
FOLDER/results.jsonl stores results by content: the trial, the program's own source, the data set and the kind
of processor.
After Ctrl-C the same command resumes.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.result_store import ResultStore, processor
from edge_server.experiments.common.result_store import content_key as key_of
from edge_server.experiments.common.source_digest import source_digest
from edge_server.experiments.common.worker import WorkerContext, end_at_once, init_worker
from edge_server.experiments.studies.trial import Row, Trial, run_trial
from edge_server.fields.common.threads.thread_pool import THREADS_VARIABLE
from edge_server.report.machine import versions
from freshfield.machine_load import usable_cores

# Trials per task: enough to share images, few enough that Ctrl-C loses little work.
_TRIALS_A_TASK = 6


class StudyError(RuntimeError):
    """A study that cannot be run as asked; the message says what to change."""


Task = list[dict[str, Any]]
"""Trials with the same images, as mappings; sent to a process or machine."""


def run_task(task: Task, folders: Folders, kind: str | None = None) -> list[Row]:
    """Return the results of a task's trials, in order. Every backend runs this function.

    kind: the kind of processor that results are stored for; None: any. Raises StudyError on another kind.
    """
    if kind is not None and kind != processor():
        raise StudyError(f"--ray: {processor()} computes other last bits than {kind}: give it one kind of processor")
    return [run_trial(Trial(**mapping), folders) for mapping in task]


@dataclass
class Engine:
    """Runs trials and stores their results in ``folder``.

    folders: data sets and weights.
    jobs: number of processes; 1 runs everything in this one.
    ray: address of a Ray cluster (``auto``, ``local`` or host:port) to use instead of processes.
    say: called with each line of progress.
    """

    folder: Path
    folders: Folders = field(default_factory=Folders)
    jobs: int = 1
    ray: str | None = None
    say: Callable[[str], None] = print
    _store: ResultStore | None = None

    def run(self, trials: Sequence[Trial], name: str = "study") -> list[Row]:
        """The result of each trial, in the order given. Raises StudyError; KeyboardInterrupt leaves what is
        finished in the folder."""
        if not trials:
            return []
        store = self._store = self._store or ResultStore.in_lines(self.folder / "results.jsonl")
        keys = [content_key(trial, self.folders) for trial in trials]
        wanted: dict[str, Trial] = {}
        for key, trial in zip(keys, trials):
            if store.find(key) is None:
                wanted[key] = trial
        total, done, began = len(wanted), 0, time.monotonic()
        if total:
            self.say(f"{name}: {total} trials to run, {len(set(keys)) - total} known")
        for task, results in self._results(wanted):
            for key, result in zip(task, results):
                store.put(key, result={"trial": wanted[key].mapping(), "result": result})
            done += len(task)
            spent = time.monotonic() - began
            left = spent / done * (total - done)
            self.say(f"{name}: {done}/{total} trials, {spent:.0f} s, {left:.0f} s left")
        return [store.results[key]["result"] for key in keys]

    def _results(self, wanted: dict[str, Trial]) -> Iterator[tuple[list[str], list[Row]]]:
        """Each task's keys and results, as they come."""
        tasks = _tasks(wanted)
        sent: list[Task] = [[wanted[key].mapping() for key in task] for task in tasks]
        if self.ray is not None and tasks:
            yield from self._on_ray(tasks, sent)
        elif self.jobs > 1 and len(tasks) > 1:
            yield from self._in_processes(tasks, sent)
        else:
            for task, mappings in zip(tasks, sent):
                yield task, run_task(mappings, self.folders)

    def _in_processes(self, tasks: list[list[str]], sent: list[Task]) -> Iterator[tuple[list[str], list[Row]]]:
        # Fresh processes: forking one that has threads of kernels in it would hang.
        jobs = min(self.jobs, len(tasks))
        pool = ProcessPoolExecutor(jobs, WorkerContext(), init_worker, (max(1, usable_cores() // jobs),))
        try:
            running: dict[Future[list[Row]], list[str]] = {
                pool.submit(run_task, mappings, self.folders): task for task, mappings in zip(tasks, sent)
            }
            for future in as_completed(running):
                yield running[future], future.result()
        except BaseException:
            end_at_once(pool)
            raise
        pool.shutdown()

    def _on_ray(self, tasks: list[list[str]], sent: list[Task]) -> Iterator[tuple[list[str], list[Row]]]:
        try:
            import ray
        except ImportError:
            raise StudyError("--ray needs Ray: pip install 'freshfield[cluster]'") from None
        assert self.ray is not None
        if not ray.is_initialized():
            _start_ray(ray, self.ray)
        remote: Any = ray.remote(num_cpus=1, runtime_env={"env_vars": {THREADS_VARIABLE: "1"}})(run_task)
        running = {remote.remote(mappings, self.folders, processor()): task for task, mappings in zip(tasks, sent)}
        try:
            while running:
                finished, _ = ray.wait(list(running), num_returns=1)
                for reference in finished:
                    yield running.pop(reference), ray.get(reference)
        except BaseException:
            for reference in running:
                ray.cancel(reference, force=True)
            raise


def _start_ray(ray: Any, where: str) -> None:
    """Join the cluster at an address, or start one here ("local"). Raises StudyError."""
    attempts = 2 if where == "local" else 1  # the first start on a cold disk may exceed Ray's 30 seconds
    for left in reversed(range(attempts)):
        try:
            ray.init(address=None if where == "local" else where, log_to_driver=False, include_dashboard=False)
            return
        except Exception as error:  # Ray raises this very class where a node starts too slowly
            ray.shutdown()
            if not left:
                raise StudyError(f"--ray {where}: no cluster can be reached: {error}") from None


def content_key(trial: Trial, folders: Folders) -> str:
    """The key of a stored result: a hash of the trial, the source that computes it and the data it reads."""
    scenario = trial.scenario()
    parts = {
        "trial": trial.mapping(),
        "scenario": [scenario.source, scenario.channel, scenario.edge, scenario.cameras, scenario.held_out],
        "source": source_digest(),
        "versions": _versions(),
        "data": _data_digest(folders.data, scenario.source.get("data")),
        "lpips": _weights_digest(folders.lpips) if trial.lpips else None,
    }
    return key_of(parts, 40)


@cache
def _data_digest(folder: Path | None, name: str | None) -> str | None:
    """Digest of a recorded data set: names and sizes of its files, and the contents of its small text
    files."""
    if name is None:
        return None
    path = Path(name) if folder is None else folder / name
    home = path if path.is_dir() else path.parent
    digest = hashlib.sha256()
    for file in sorted(home.rglob("*")) if home.is_dir() else []:
        if file.is_file():
            size = file.stat().st_size
            digest.update(f"{file.relative_to(home)} {size}".encode())
            if file.suffix in (".json", ".txt") and size < 10_000_000:
                digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


_versions = cache(versions)


@cache
def _weights_digest(folder: Path | None) -> str | None:
    if folder is None or not folder.is_dir():
        return None
    digest = hashlib.sha256()
    for file in sorted(folder.glob("*.npz")):
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()[:16]


def _tasks(wanted: dict[str, Trial]) -> list[list[str]]:
    """Group keys into tasks whose trials share images and instants, in the given order."""
    groups: dict[tuple[Any, ...], list[str]] = {}
    for key, trial in wanted.items():
        kind = (trial.field, json.dumps(trial.field_options, sort_keys=True))
        groups.setdefault((*trial.stage, *kind, trial.seed), []).append(key)
    return [group[i : i + _TRIALS_A_TASK] for group in groups.values() for i in range(0, len(group), _TRIALS_A_TASK)]
