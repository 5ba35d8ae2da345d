"""Seeds and faults of ``pytest -m chaos``, from the command line."""

from __future__ import annotations

import pytest


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if metafunc.definition.get_closest_marker("chaos") is not None:
        metafunc.parametrize("seed", _seeds(metafunc.config.getoption("--seeds")))


@pytest.fixture
def faults(request: pytest.FixtureRequest) -> list[int] | None:
    """Numbers of the faults to carry out; None: all."""
    words = request.config.getoption("--faults")
    return None if words is None else [int(word) for word in words.split(",") if word != "none"]


def _seeds(text: str) -> list[int]:
    """``A..B``, or numbers separated by commas."""
    first, dots, last = text.partition("..")
    return list(range(int(first), int(last) + 1)) if dots else [int(word) for word in text.split(",")]
