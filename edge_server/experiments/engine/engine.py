"""Runs a function over many inputs: here, in processes (joblib) or as tasks of a Ray cluster."""

from __future__ import annotations

import itertools
import json
import os
import platform
import signal
import sys
import threading
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, TypeVar

import cv2

from edge_server.experiments.engine.content_key import plain, result_key, surroundings
from edge_server.experiments.engine.engine_constants import BATCH, PARENT_EVERY_S, RETRIES
from edge_server.fields.common.threads.thread_pool import THREADS_VARIABLE
from edge_server.fields.field_constants import MOST_WORKERS
from edge_server.progress import ProgressLine
from freshfield.files import Lines
from freshfield.machine_load import usable_cores

Input = TypeVar("Input")


class EngineError(RuntimeError):
    """Work that cannot be run as asked; the message says what to change."""


class ResultStore:
    """Results by key. Each is a line ``{"key": ..., "inputs": ..., "result": ...}`` of the file.

    path: the file, which is made if it does not exist. Incomplete lines are ignored; of several lines with one key
    the last counts. None: results are kept in memory only.
    Raises OSError if the file cannot be opened.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.results: dict[str, Any] = {}
        """The known results by key."""
        self._lines: Lines | None = None
        if path is None:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        for line in path.read_text(errors="replace").splitlines() if path.exists() else ():
            try:
                found = json.loads(line)
                self.results[str(found["key"])] = found["result"]
            except (ValueError, KeyError, TypeError):
                continue
        self._lines = Lines(path)

    def put(self, key: str, inputs: Any, result: Any) -> None:
        """Keep a result (a JSON value), with its inputs for whoever reads the file."""
        self.results[key] = result
        if self._lines is not None:
            self._lines.write(json.dumps({"key": key, "inputs": inputs, "result": result}, default=plain))

    def close(self) -> None:
        """Close the file."""
        if self._lines is not None:
            self._lines.close()


def _say(line: str) -> None:
    print(line, flush=True)  # also in a pipe, before the first result


@dataclass
class Engine:
    """Computes results and keeps them; see the package's docstring.

    file: the JSON lines that keep the results; None keeps them in memory.
    jobs: number of processes; 1 computes in this one.
    ray: address of a Ray cluster (``auto``, ``local`` or HOST:PORT) to use instead of processes.
    threads: number of threads of each process; None: an equal share of the cores.
    say: called with what is to be computed; how far it is, is a line of a terminal (``ProgressLine``). None: a pipe
        gets no line, for callers that say themselves how far they are.
    Raises EngineError for less than one process.
    """

    file: Path | None = None
    jobs: int = 1
    ray: str | None = None
    threads: int | None = None
    say: Callable[[str], None] | None = _say
    _store: ResultStore | None = None

    def __post_init__(self) -> None:
        if self.jobs < 1:
            raise EngineError(f"--jobs: expected at least 1, got {self.jobs}")

    def run(
        self,
        work: Callable[[Input], Any],
        inputs: Sequence[Input],
        name: str = "work",
        *,
        files: Callable[[Input], Iterable[Path | None]] | None = None,
        group: Callable[[Input], Hashable] | None = None,
        batch: int = BATCH,
    ) -> list[Any]:
        """The result of ``work`` for each of ``inputs``, in their order; known ones are not computed again.

        name: what progress is reported of.
        files: the files and folders that the result of an input depends on.
        group: what inputs share; those of equal value are computed in one process, in turn.
        batch: most inputs of a task.
        Raises EngineError, and whatever ``work`` raises. After KeyboardInterrupt the file has what was finished.
        """
        store = self._store = self._store or ResultStore(self.file)
        keys = [result_key(work, one, files(one) if files else ()) for one in inputs]
        wanted = {key: one for key, one in zip(keys, inputs) if key not in store.results}
        total, done, progress = len(wanted), 0, ProgressLine(sys.stderr, quiet_in_pipe=self.say is None)
        if not total:
            return [store.results[key] for key in keys]
        if self.say is not None:
            self.say(f"{name}: {total} to compute, {len(set(keys)) - total} known")
        with progress.running(name):
            for task, results in self._results(work, _tasks(wanted, group, batch)):
                for (key, one), result in zip(task, results):
                    store.put(key, one, result)
                    done += 1
                progress(name, done / total)
        return [store.results[key] for key in keys]

    def close(self) -> None:
        """Close the file of results."""
        if self._store is not None:
            self._store.close()
            self._store = None

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _results(self, work: Callable[[Input], Any], tasks: list[_Task[Input]]) -> Iterator[tuple[Any, list[Any]]]:
        """Each task with its results, as they come."""
        if self.ray is not None and tasks:
            yield from _on_ray(self.ray, self.threads, work, tasks)
        elif self.jobs > 1 and len(tasks) > 1:
            yield from _in_processes(min(self.jobs, len(tasks)), self.threads, work, tasks)
        else:
            if self.threads is not None and tasks:
                limit_threads(self.threads)
            for one in itertools.chain(*tasks):
                yield [one], _compute(work, [one], 0)[1]


_Task = list[tuple[str, Input]]
"""Keys and inputs that one process computes in turn."""


def _tasks(
    wanted: dict[str, Input], group: Callable[[Input], Hashable] | None, batch: int
) -> list[list[tuple[str, Input]]]:
    groups: dict[Hashable, list[tuple[str, Input]]] = {}
    for key, one in wanted.items():
        groups.setdefault(key if group is None else ("group", group(one)), []).append((key, one))
    return [of[i : i + batch] for of in groups.values() for i in range(0, len(of), batch)]


def _compute(work: Callable[[Any], Any], task: Any, number: int) -> tuple[int, list[Any]]:
    """The number of a task and its results, as they come back from a file. Every backend runs this function."""
    return number, [json.loads(json.dumps(work(one), default=plain)) for _, one in task]


def _in_processes(
    jobs: int, threads: int | None, work: Callable[[Any], Any], tasks: Sequence[Any]
) -> Iterator[tuple[Any, list[Any]]]:
    import joblib

    start = threads or max(1, usable_cores() // jobs), threads is not None
    # New processes inherit the mask: Ctrl-C is for this one, which then ends them. Python 3.11's tracker of resources
    # unblocks SIGINT where it is started with the first of them.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with joblib.parallel_config("loky", initializer=_init_worker, initargs=start):
            parallel = joblib.Parallel(jobs, return_as="generator_unordered", batch_size=1)
            computed = parallel(joblib.delayed(_compute)(work, task, k) for k, task in enumerate(tasks))
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    for number, results in computed:  # after an error or Ctrl-C, its end ends the processes at once
        yield tasks[number], results


def _on_ray(
    where: str, threads: int | None, work: Callable[[Any], Any], tasks: Sequence[Any]
) -> Iterator[tuple[Any, list[Any]]]:
    """As Ray's own tasks, not through joblib's backend for Ray: its actors count no core, so that all may start on one
    machine, and the death of one ends the run. Ray repeats a task whose worker or machine died wherever a core is free.
    """
    join_cluster(where)
    import ray

    remote = ray.remote(_compute_on_ray).options(
        num_cpus=threads or 1,
        max_retries=RETRIES,
        runtime_env={"env_vars": {THREADS_VARIABLE: str(threads or 1)}},  # read when kernels are imported
    )
    shared = ray.put(work)  # may hold a policy's weights
    waiting = [remote.remote(shared, task, k, surroundings(work), threads) for k, task in enumerate(tasks)]
    try:
        while waiting:
            (ended,), waiting = ray.wait(waiting)
            number, results = ray.get(ended)
            yield tasks[number], results
    except (ray.exceptions.WorkerCrashedError, ray.exceptions.NodeDiedError, ray.exceptions.OutOfMemoryError) as error:
        raise EngineError(f"--ray: a task ended its worker {RETRIES + 1} times: {error}") from None
    finally:
        for left in waiting:
            ray.cancel(left, force=True)


def _compute_on_ray(
    work: Callable[[Any], Any], task: Any, number: int, expected: dict[str, Any], threads: int | None
) -> tuple[int, list[Any]]:
    """``_compute`` on a machine of a cluster.

    expected: ``surroundings`` where the keys were made. threads: as in ``Engine``.
    Raises EngineError if results of this machine would be kept under keys that are not theirs.
    """
    here = surroundings(work)
    if other := [name for name, value in expected.items() if here[name] != value]:
        raise EngineError(
            f"--ray: machine {platform.node()} differs in {', '.join(other)}: results would differ in their last bits; "
            "install the same freshfield and packages on machines of one kind of processor"
        )
    (_share_cores if threads is None else limit_threads)(threads or 1)
    return _compute(work, task, number)


def limit_threads(threads: int) -> None:
    """Set the number of threads of OpenCV, of torch and, up to ``MOST_WORKERS``, of our kernels in this process. The
    number of threads that share a convolution of torch changes its last bits."""
    import torch

    _share_cores(threads)
    torch.set_num_threads(threads)


def _share_cores(threads: int) -> None:
    os.environ[THREADS_VARIABLE] = str(min(threads, MOST_WORKERS))
    cv2.setNumThreads(threads)


def _init_worker(threads: int, exact: bool) -> None:
    """Initializer of a process: give it its threads, and end it when its parent ends, however that happens.

    exact: results depend on the number of threads.
    """
    os.environ["OMP_NUM_THREADS"] = str(threads)  # torch reads it when it is imported
    (limit_threads if exact else _share_cores)(threads)
    threading.Thread(target=_end_with, args=(os.getppid(),), name="parent", daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(PARENT_EVERY_S)
    os._exit(1)  # at once: nobody waits for half a result


def join_cluster(where: str) -> None:
    """Join the cluster at an address, or start one here ("local"). Raises EngineError."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a cluster started here tells nobody about its use
    try:
        import ray
    except ImportError:
        raise EngineError("--ray needs Ray: pip install 'freshfield[cluster]'") from None
    attempts = 2 if where == "local" else 1  # the first start on a cold disk may exceed Ray's 30 seconds
    for left in reversed(range(attempts)):
        try:
            if not ray.is_initialized():
                ray.init(address=where, log_to_driver=False, include_dashboard=False)
            break
        except Exception as error:  # Ray raises this very class where a node starts too slowly
            ray.shutdown()
            if not left:
                raise EngineError(f"--ray {where}: no cluster can be reached: {error}") from None
