"""Repeated work: the same results whoever computes them, none twice, and none of other code, data or inputs."""

import importlib
import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from edge_server.experiments.engine import Engine, EngineError, content_key
from edge_server.experiments.engine.content_key import code_digest, result_key, surroundings
from edge_server.experiments.engine.engine import ResultStore, _compute_on_ray
from edge_server.settings import ComputeConfig
from tests.edge_server.experiments.engine.jobs import Point, end_worker, fail, measure, measure_on_ray, note
from tests.support import alive, refused, wait_until

POINTS = [Point(seed, scene=scene) for scene in ("room", "tower") for seed in range(4)]


def opened(file=None, **how) -> Engine:
    return Engine(file, say=lambda line: None, **how)


@pytest.fixture(scope="module")
def serial() -> list:
    return opened().run(measure, POINTS)


def test_results_come_in_the_order_of_the_inputs_whoever_computes_them_and_from_a_file(serial, tmp_path):
    assert [round(row["mean"], 6) for row in serial[:2]] == [0.081097, -0.073612]
    with opened(tmp_path / "r.jsonl") as engine:
        assert repr(engine.run(measure, POINTS[::-1])[::-1]) == repr(serial)
    with opened(tmp_path / "r.jsonl") as engine, opened(jobs=2) as parallel:
        assert repr(engine.run(measure, POINTS)) == repr(serial)
        assert repr(parallel.run(measure, POINTS, group=lambda p: p.scene, batch=3)) == repr(serial)


@pytest.mark.slow
@pytest.mark.alone
def test_two_ray_nodes_compute_the_same_bit_for_bit_though_workers_are_lost(serial, tmp_path, request):
    ray = pytest.importorskip("ray", reason="needs Ray: pip install 'freshfield[cluster]'")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    request.addfinalizer(cluster.shutdown)
    request.addfinalizer(ray.shutdown)
    cluster.add_node(num_cpus=1)
    engine = opened(tmp_path / "r.jsonl", ray=cluster.address)
    work = partial(measure_on_ray, folder=tmp_path)
    assert repr(engine.run(work, POINTS, group=lambda p: p.scene, batch=1)) == repr(serial)
    calls = [path.name.split("-")[1:] for path in tmp_path.glob("call-*")]
    assert sorted(seed for seed, *_ in calls) == sorted([*"01233"] * 2), "each once, and those that ended their worker"
    assert len({node for _, _, node, _ in calls}) == 2
    assert len((tmp_path / "r.jsonl").read_text().splitlines()) == len(POINTS)

    refused(EngineError, "a task ended its worker 4 times", engine.run, end_worker, POINTS[:1])
    engine.close()


@pytest.mark.parametrize("what", ["code", "versions", "processor"])
def test_a_machine_of_a_cluster_whose_results_would_differ_is_refused(what):
    with pytest.raises(EngineError, match=f"differs in {what}: .* one kind of processor"):
        _compute_on_ray(measure, [("key", POINTS[0])], 0, {**surroundings(measure), what: "other"}, None)


def test_what_is_known_is_not_computed_again_and_one_key_is_computed_once(tmp_path):
    engine, work = opened(tmp_path / "r.jsonl"), partial(note, folder=tmp_path)
    assert len(set(engine.run(work, [*POINTS, *POINTS]))) == 1
    assert engine.run(partial(note, folder=tmp_path / "elsewhere"), POINTS[:2]) == [os.getpid()] * 2
    assert len(list(tmp_path.glob("*.call"))) == len(POINTS)
    line = json.loads((tmp_path / "r.jsonl").read_text().splitlines()[0])
    assert line["inputs"] == {"seed": 0, "size": 100, "scene": "room"} and line["result"] == os.getpid()


@pytest.mark.parametrize("jobs", [1, 2])
def test_after_an_error_the_file_has_what_was_finished(jobs, tmp_path):
    with pytest.raises(ValueError, match="seed 3 cannot"), opened(tmp_path / "r.jsonl", jobs=jobs) as engine:
        engine.run(fail, [Point(seed) for seed in range(4)])
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
    for pid in workers():  # SIGINT is blocked: while a process starts, it would leave a traceback
        blocked = Path(f"/proc/{pid}/status").read_text().split("SigBlk:")[1].split()[0]
        assert int(blocked, 16) >> (signal.SIGINT - 1) & 1
    if how == signal.SIGINT:
        os.killpg(parent.pid, how)  # as a terminal does: to all of them
    else:
        parent.send_signal(how)
    errors = parent.communicate(timeout=30.0)[1]
    assert errors.count("Traceback") == (how == signal.SIGINT), errors
    wait_until(lambda: not any(alive(pid) for pid in workers()), "a process goes on without its parent")
    assert [json.loads(line)["result"] for line in (tmp_path / "r.jsonl").read_text().splitlines()] == [0]


CODE = '''
"""What it does."""
import json

def work(one):
    """Adds."""
    # a comment
    return one["a"] + 1
'''


def test_inputs_count_by_content_and_not_order_and_the_function_without_what_is_bound_to_it():
    assert result_key(measure, {"a": 1, "b": [2]}) == result_key(measure, {"b": (2,), "a": 1})
    inputs = (1, 1.5, "1", [1], Point(1), Point(2), Point(1, scene="tower"), ComputeConfig(2.0))
    assert len({result_key(measure, each) for each in inputs}) == 8
    refused(TypeError, "no JSON value", result_key, measure, object())
    bound = [result_key(partial(note, folder=Path(f)), Point(1)) for f in ("here", "there")]
    assert bound[0] == bound[1] == result_key(note, Point(1)) != result_key(measure, Point(1))


def test_the_kind_of_processor_and_the_versions_count(monkeypatch):
    key = result_key(measure, 1)
    monkeypatch.setattr(content_key, "processor", lambda: "x86_64 haswell")
    other = result_key(measure, 1)
    monkeypatch.setattr(content_key, "_versions", lambda: {"numpy": "1.0"})
    assert len({key, other, result_key(measure, 1)}) == 3


def test_files_count_by_their_contents_not_by_their_place_or_time(tmp_path):
    for name, text in (("a/x.txt", "one"), ("b/x.txt", "one"), ("c/y.txt", "one"), ("d/x.txt", "two")):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text(text)
    a, b, c, d = (result_key(measure, 1, [None, tmp_path / name]) for name in "abcd")
    assert a == b and len({a, c, d, result_key(measure, 1)}) == 4
    (tmp_path / "a/x.txt").write_text("six")
    assert result_key(measure, 1, [tmp_path / "a"]) != a
    refused(OSError, "", result_key, measure, 1, [tmp_path / "missing"])


def test_a_class_from_outside_counts_with_all_that_it_imports_from_its_folder(tmp_path):
    """A module beside it, a package beside it, and what these import."""
    texts = {"mine.py": "import beside, package\nimport json", "beside.py": "import further", "further.py": "x = 1"}
    texts |= {"package/__init__.py": "", "package/part.py": "y = 1", "unrelated.py": "z = 1"}
    (tmp_path / "package").mkdir()
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    keys = [result_key(measure, {"policy": f"{tmp_path}/mine.py:Mine:3"})]
    for name in texts:
        (tmp_path / name).write_text("changed = True")
        keys.append(result_key(measure, {"policy": f"{tmp_path}/mine.py:Mine:3"}))
        (tmp_path / name).write_text(texts[name])
    assert len(set(keys[:-1])) == len(texts) and keys[-1] == keys[0]


@pytest.fixture
def digest(tmp_path, monkeypatch):
    """The digest of the code of a module with a text."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def of(text: str) -> str:
        (tmp_path / "some_work.py").write_text(text)
        importlib.invalidate_caches()
        sys.modules.pop("some_work", None)
        importlib.import_module("some_work")
        code_digest.cache_clear()
        return code_digest("some_work")

    yield of
    sys.modules.pop("some_work", None)


def test_a_formatter_run_changes_nothing_and_an_operator_does(digest):
    before = digest(CODE)
    changed = CODE.replace('"a"', "'a'").replace("# a comment", "").replace("Adds.", "Sums up.").replace("    ", "  ")
    assert digest(changed) == before
    assert digest(CODE.replace("+ 1", "- 1")) != before


def test_lines_outlive_the_process_and_a_torn_last_one_counts_as_none(tmp_path):
    path = tmp_path / "made" / "results.jsonl"
    store = ResultStore(path)
    for key, value in (("a", 1), ("b", 2), ("a", 3)):
        store.put(key, {"seed": 1}, value)
    store.close()
    path.write_text(path.read_text() + '{"key": "c", "resu')
    again = ResultStore(path)
    assert again.results == {"a": 3, "b": 2}
    again.put("d", {}, 4)
    again.close()
    assert ResultStore(path).results == {"a": 3, "b": 2, "d": 4}, "half a line swallowed the next one"
