"""Every target takes its honest inputs and refuses, in one line, its corpus and variants of both."""

from __future__ import annotations

import random
import time
from functools import partial

import pytest

from freshfield.session import SessionError
from tests.fuzz.targets import MOST_FILE_MS, MOST_MS, TARGETS, seeds
from tests.support import work_ms

HONEST = {"request": 3, "header": 2, "payload": 3, "depth": 2, "scenario": 15, "checkpoint": 1, "mcap": 1}
ACCEPTED = ("accepted", "read", "jpeg", "png", "zstd", "depth", "2 cameras")


@pytest.mark.parametrize("name", TARGETS)
def test_what_strangers_send_is_taken_or_refused(name, tmp_path):
    try:
        given = seeds(name)
    except SessionError as error:
        pytest.skip(str(error))
    target = TARGETS[name](tmp_path)
    assert sum(target(data) in ACCEPTED for data in given) >= HONEST[name]
    rng = random.Random(1)
    for data in given:
        for _ in range(40 if name in MOST_MS else 10):
            cut, width, byte = rng.randrange(len(data) + 1), rng.choice((0, 1, 8)), rng.randbytes(1)
            changed = data[:cut] + byte * rng.choice((0, 1, 8)) + data[cut + width :]
            begun, most_ms = time.thread_time(), MOST_MS.get(name, MOST_FILE_MS)
            target(changed)
            took_ms = (time.thread_time() - begun) * 1e3
            assert took_ms < most_ms or work_ms(partial(target, changed)) < most_ms
