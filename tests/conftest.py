"""Shared by all tests: where real data lies, and nothing that hides what a test does."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# A deadline per example measures the machine's load, not the code; one seed, one result holds for tests too.
settings.register_profile("freshfield", deadline=None, derandomize=True)
settings.load_profile("freshfield")

ROOT = Path(__file__).resolve().parent.parent


def data_dir(name: str) -> Path:
    """Folder ``name`` of the real input data, or skip with the reason.

    Looked for in $FRESHFIELD_DATA, then in ../shared/data beside the checkout.
    """
    for base in (os.environ.get("FRESHFIELD_DATA"), ROOT.parent / "shared" / "data"):
        if base and (Path(base) / name).is_dir():
            return Path(base) / name
    pytest.skip(f"real data set {name!r} not found: set FRESHFIELD_DATA to the folder that holds it")
