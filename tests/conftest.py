"""Shared by all tests: where real data lies, and nothing that hides what a test does."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

# A deadline per example measures the machine's load, not the code; one seed, one result holds for tests too.
settings.register_profile("freshfield", deadline=None, derandomize=True)
settings.load_profile("freshfield")

ROOT = Path(__file__).resolve().parent.parent


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


def data_dir(name: str) -> Path:
    """Folder ``name`` of the real input data, or skip with the reason.

    Looked for in $FRESHFIELD_DATA, then in ../shared/data beside the checkout.
    """
    for base in (os.environ.get("FRESHFIELD_DATA"), ROOT.parent / "shared" / "data"):
        if base and (Path(base) / name).is_dir():
            return Path(base) / name
    pytest.skip(f"real data set {name!r} not found: set FRESHFIELD_DATA to the folder that holds it")
