"""Counter-based random numbers, looked up by seed, camera, purpose and number.

A stateful generator would make a frame's outcome depend on how many numbers other frames used. Here number
``n`` of a stream is a pure function (Philox4x32-10, Salmon et al., "Parallel random numbers: as easy as
1, 2, 3", SC 2011), so adding a camera changes nothing for the others, and a replay that asks in another
order gets the same numbers.
"""

from __future__ import annotations

import math

import numpy as np

from freshfield.scenario import seed_sequence

_MULTIPLY_0, _MULTIPLY_1 = 0xD2511F53, 0xCD9E8D57
_WEYL_0, _WEYL_1 = 0x9E3779B9, 0xBB67AE85
_WORD = 0xFFFFFFFF


def philox4x32(counter: tuple[int, int, int, int], key: tuple[int, int]) -> tuple[int, int, int, int]:
    """Ten rounds of Philox4x32: map four 32-bit counter words and two key words to four random words."""
    c0, c1, c2, c3 = counter
    k0, k1 = key
    for _ in range(10):
        p0, p1 = _MULTIPLY_0 * c0, _MULTIPLY_1 * c2
        c0, c1, c2, c3 = (p1 >> 32) ^ c1 ^ k0, p1 & _WORD, (p0 >> 32) ^ c3 ^ k1, p0 & _WORD
        k0, k1 = (k0 + _WEYL_0) & _WORD, (k1 + _WEYL_1) & _WORD
    return c0, c1, c2, c3


def _unit(low: int, high: int) -> float:
    # 52 bits and a half step: strictly inside (0, 1) and exact in float64, so a logarithm is always finite.
    return (((high << 32 | low) >> 12) + 0.5) * 2.0**-52


def stream_key(seed: int, camera: str, purpose: str) -> tuple[int, int]:
    """The key of one camera's stream for one purpose, from ``freshfield.scenario.seed_sequence``.

    Raises ValueError unless the seed is within 0 to 2^63 - 1.
    """
    if not 0 <= seed < 2**63:
        raise ValueError(f"seed: expected a whole number from 0 to 2^63 - 1, got {seed}")
    low, high = seed_sequence(seed, purpose, camera).generate_state(2, np.uint32)
    return int(low), int(high)


class CounterRng:
    """One stream: ``pair(n)`` gives the two independent uniforms in (0, 1) of number ``n``.

    ``attempt`` selects further pairs of the same number, for rejection sampling.
    """

    __slots__ = ("key",)

    def __init__(self, seed: int, camera: str, purpose: str) -> None:
        self.key = stream_key(seed, camera, purpose)

    def pair(self, n: int, attempt: int = 0) -> tuple[float, float]:
        a, b, c, d = philox4x32((n & _WORD, n >> 32, attempt, 0), self.key)
        return _unit(a, b), _unit(c, d)

    def uniform(self, n: int, attempt: int = 0) -> float:
        return self.pair(n, attempt)[0]

    def exponential(self, n: int) -> float:
        """Unit-mean exponential number ``n``."""
        return -math.log(self.pair(n)[0])
