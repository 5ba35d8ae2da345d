"""Repeated work: the same results whoever computes them, none twice, and none of other code, data or inputs."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from edge_server.experiments.engine import Engine, EngineError
from edge_server.experiments.engine.content_key import surroundings
from edge_server.experiments.engine.engine import _compute_on_ray
from tests.edge_server.experiments.engine.jobs import Point, end_worker, fail, measure, measure_on_ray, note
from tests.support import wait_until

POINTS = [Point(seed, scene=scene) for scene in ("room", "tower") for seed in range(4)]


def quiet(_: str) -> None:
    pass


def run(engine: Engine, work=measure, points=POINTS, **how):
    engine.say = quiet
    with engine:
        return engine.run(work, points, **how)


@pytest.fixture(scope="module")
def serial() -> list:
    return run(Engine())


def test_results_come_in_the_order_of_the_inputs_as_they_come_back_from_a_file(serial, tmp_path):
    assert [round(row["mean"], 6) for row in serial[:2]] == [0.081097, -0.073612]
    assert isinstance(serial[0]["ends"], list)
    backwards = run(Engine(tmp_path / "r.jsonl"), points=POINTS[::-1])
    assert repr(backwards[::-1]) == repr(serial)
    again = run(Engine(tmp_path / "r.jsonl"), work=measure)
    assert repr(again) == repr(serial)


def test_processes_compute_the_same_bit_for_bit(serial):
    assert repr(run(Engine(jobs=2), group=lambda p: p.scene, batch=3)) == repr(serial)


@pytest.mark.slow
@pytest.mark.alone
def test_two_ray_nodes_compute_the_same_bit_for_bit_though_workers_are_lost(serial, tmp_path, request):
    ray = pytest.importorskip("ray", reason="needs Ray: pip install 'freshfield[cluster]'")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    request.addfinalizer(cluster.shutdown)
    request.addfinalizer(ray.shutdown)
    cluster.add_node(num_cpus=1)
    engine = Engine(tmp_path / "r.jsonl", ray=cluster.address, say=quiet)
    work = partial(measure_on_ray, folder=tmp_path)
    assert repr(engine.run(work, POINTS, group=lambda p: p.scene, batch=1)) == repr(serial)
    calls = [path.name.split("-")[1:] for path in tmp_path.glob("call-*")]
    assert sorted(seed for seed, *_ in calls) == sorted([*"01233"] * 2), "each once, and those that ended their worker"
    assert len({node for _, _, node, _ in calls}) == 2
    assert len((tmp_path / "r.jsonl").read_text().splitlines()) == len(POINTS)

    with pytest.raises(EngineError, match="a task ended its worker 4 times"):
        engine.run(end_worker, POINTS[:1])
    engine.close()


@pytest.mark.parametrize("what", ["code", "versions", "processor"])
def test_a_machine_of_a_cluster_whose_results_would_differ_is_refused(what):
    with pytest.raises(EngineError, match=f"differs in {what}: .* one kind of processor"):
        _compute_on_ray(measure, [("key", POINTS[0])], 0, {**surroundings(measure), what: "other"}, None)


def test_what_is_known_is_not_computed_again_and_one_key_is_computed_once(tmp_path):
    engine, work = Engine(tmp_path / "r.jsonl", say=quiet), partial(note, folder=tmp_path)
    assert len(set(engine.run(work, [*POINTS, *POINTS]))) == 1
    assert engine.run(partial(note, folder=tmp_path / "elsewhere"), POINTS[:2]) == [os.getpid()] * 2
    assert len(list(tmp_path.glob("*.call"))) == len(POINTS)
    line = json.loads((tmp_path / "r.jsonl").read_text().splitlines()[0])
    assert line["inputs"] == {"seed": 0, "size": 100, "scene": "room"} and line["result"] == os.getpid()


@pytest.mark.parametrize("jobs", [1, 2])
def test_after_an_error_the_file_has_what_was_finished(jobs, tmp_path):
    engine = Engine(tmp_path / "r.jsonl", jobs=jobs)
    with pytest.raises(ValueError, match="seed 3 cannot be computed"):
        run(engine, fail, [Point(seed) for seed in range(4)])
    kept = [json.loads(line)["result"] for line in (tmp_path / "r.jsonl").read_text().splitlines()]
    assert set(kept) <= {0, 1, 2} and (jobs == 2 or kept == [0, 1, 2])


PARENT = """
import sys
from functools import partial
from pathlib import Path
from edge_server.experiments.engine import Engine
from tests.edge_server.experiments.engine.jobs import Point, sleep

folder = Path(sys.argv[1])
Engine(folder / "r.jsonl", jobs=2).run(partial(sleep, folder=folder), [Point(seed) for seed in range(3)])
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_however_it_ends_its_processes_end_too_and_what_was_finished_is_kept(how, tmp_path):
    words = [sys.executable, "-c", PARENT, str(tmp_path)]
    parent = subprocess.Popen(words, stderr=subprocess.PIPE, text=True, start_new_session=True)

    def workers() -> list[int]:
        return [int(path.name.split("-")[2]) for path in tmp_path.glob("started-[12]-*")]

    wait_until(lambda: len(workers()) == 2, "its processes do not start", 120.0)
    wait_until((tmp_path / "r.jsonl").read_text, "the first result is not kept", 60.0)
    if how == signal.SIGINT:
        os.killpg(parent.pid, how)  # as a terminal does: to all of them
    else:
        parent.send_signal(how)
    errors = parent.communicate(timeout=30.0)[1]
    assert errors.count("Traceback") == (how == signal.SIGINT), errors
    wait_until(lambda: not any(_alive(pid) for pid in workers()), "a process goes on without its parent")
    assert [json.loads(line)["result"] for line in (tmp_path / "r.jsonl").read_text().splitlines()] == [0]


def _alive(pid: int) -> bool:
    """A process that has ended may wait for whoever adopted it to notice."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except FileNotFoundError:
        return False
