"""Shared by all tests: where real data lies, and nothing that hides what a test does."""

import asyncio
import inspect
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# A deadline per example measures the machine's load, not the code; one seed, one result holds for tests too.
settings.register_profile("freshfield", deadline=None, derandomize=True)
settings.load_profile("freshfield")

ROOT = Path(__file__).resolve().parent.parent

# deploy/ is a folder of scripts, not an installed package: tests put it on the path as python does.
sys.path.insert(0, str(ROOT / "deploy"))

# Beside others, torch's threads wait for each other by spinning on the cores that the others compute on: two
# processes with two threads each take up to ten times as long as with one.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")

# Kernels stay where the user's lie, also for tests that give processes a cache of their own: compiling all of them
# takes minutes.
_CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
os.environ.setdefault("NUMBA_CACHE_DIR", str(_CACHE / "freshfield"))

# A shell that runs a script in the background has it ignore Ctrl-C, and Python goes along with that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# What has the machine to itself: whole deployments, and what compares instants of the wall clock. All else computes, or
# waits for what has seconds to come: whoever runs beside it changes nothing but how long it takes.
_FILES = {
    "camera_node/robot/arm": "drive_arm_command",
    "camera_node/robot/simulated_controller": "controller",
    "camera_node/robot/teleop": "teleop_command",
    "camera_node/sources/devices": "live",
    "camera_node": "clock_offset node",
    "deploy": "up",
    "edge_server/live": "loop scoring server",
    "edge_server/page/splats": "stream",
    "edge_server/page": "access_guard browser foxglove_live network_control page preferences",
}
_ALONE = {ROOT / f"tests/{folder}/test_{name}.py" for folder, names in _FILES.items() for name in names.split()}


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """A test that is a coroutine runs on an event loop of its own, for two minutes at most."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}

    async def limited() -> None:
        async with asyncio.timeout(120):
            await pyfuncitem.obj(**arguments)

    asyncio.run(limited())
    return True


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--seeds", default="2,7,23", metavar="A..B", help="seeds of -m chaos, or numbers [%(default)s]")
    parser.addoption(
        "--slow-part", default="1/1", metavar="K/N", help="of the slow tests, every N-th from the K-th [%(default)s]"
    )
    parser.addoption("--faults", metavar="K,...", help="only these faults of the seeds of -m chaos, or none [all]")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Both passes of ``make test`` import their own files alone: all of them take ten seconds."""
    asked = config.getoption("markexpr")
    if not asked.endswith("side_by_side") or not collection_path.name.startswith("test_"):
        return None
    if asked.endswith("not side_by_side"):
        return None if collection_path in _ALONE or "mark.alone" in collection_path.read_text() else True
    return collection_path in _ALONE or None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    part, parts = map(int, config.getoption("--slow-part").split("/"))
    slow = sorted(item.nodeid for item in items if item.get_closest_marker("slow") is not None)
    left_out = set(slow) - set(slow[part - 1 :: parts])
    if left_out:
        config.hook.pytest_deselected(items=[item for item in items if item.nodeid in left_out])
        items[:] = [item for item in items if item.nodeid not in left_out]
    for item in items:
        if item.path not in _ALONE and item.get_closest_marker("alone") is None:
            item.add_marker("side_by_side")


@pytest.fixture(autouse=True)
def _same_priority() -> Iterator[None]:
    """A test that leaves its process in real time starves every later one that computes beside others."""
    if not hasattr(os, "sched_getscheduler"):
        yield
        return
    before = os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)
    yield
    after = os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0)
    assert after == before, "what raises its priority belongs in a process of its own"


def data_dir(name: str, kind: str = "data") -> Path:
    """Folder ``name`` of the real input data, or skip with the reason.

    Looked for in $FRESHFIELD_DATA, then in ../shared/data beside the checkout.
    kind: "cases", of the inputs that people reported, in the folder of this name beside that of the data.
    """
    given = os.environ.get("FRESHFIELD_DATA")
    for base in (Path(given) if given else None, ROOT.parent / "shared/data"):
        if base and (found := base / name if kind == "data" else base.parent / kind / name).is_dir():
            return found
    pytest.skip(f"real data set {name!r} not found: set FRESHFIELD_DATA to the folder that holds it")


def case_dir(name: str) -> Path:
    """Folder ``name`` of the inputs that people reported, or skip with the reason."""
    return data_dir(name, "cases")
