from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from channel_emu.model.counter_rng import CounterRng, philox4x32, stream_key


@pytest.mark.parametrize(
    ("counter", "key", "words"),
    [
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    ],
)
def test_philox_gives_its_authors_known_answers(counter, key, words) -> None:
    assert philox4x32(counter, key) == words


def test_streams_differ_by_seed_camera_and_purpose_and_by_nothing_else() -> None:
    words = [(seed, "cam03", "channel.service") for seed in (7, 8, 7 + 2**32)]
    words += [(7, "cam04", "channel.service"), (7, "cam03", "channel.loss")]
    assert len({stream_key(*each) for each in words * 2}) == 5
    for seed in (-1, 2**63):
        with pytest.raises(ValueError, match="seed"):
            stream_key(seed, "a", "b")


@given(st.integers(0, 2**62), st.integers(0, 2**31), st.integers(0, 2**63 - 1))
def test_never_zero_and_never_one(number: int, again: int, seed: int) -> None:
    u, v = CounterRng(seed, "c", "p").pair(number, again)
    assert 0.0 < u < 1.0 and 0.0 < v < 1.0
