"""The passes over a frame that update a camera's plate: compare it with the plate, then let its pixels vote.

Frames, means and blurred frames are in steps of 255. Blurred means a mean of 3 x 3 pixels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.simd import fetch_add
from edge_server.fields.splat.layers import settings as tuned

MODES = 3  # colors a pixel remembers

# Bits that ``compare_with_plate`` writes.
FOREGROUND, CHANGING, LIKE_STATIC = 1, 2, 4

_ROWS = 16  # rows of pixels a task
_F0, _F1 = np.float32(0.0), np.float32(1.0)


class PlateArrays(NamedTuple):
    """What the pixels of a camera remember. The first mode is the plate.

    means, blurred: float32 (MODES, H, W, 3), running means of the frames and of the blurred frames.
    weight: float32 (MODES, H, W), decaying counts of votes, largest first.
    total: float32 (H, W), decaying count of arrivals.
    run: int32 (H, W), arrivals in a row that joined another mode than the plate.
    deviation: float32 (H, W), mean difference of background from the plate.
    known: bool (H, W), where the plate has enough votes.
    """

    means: NDArray[np.float32]
    blurred: NDArray[np.float32]
    weight: NDArray[np.float32]
    total: NDArray[np.float32]
    run: NDArray[np.int32]
    deviation: NDArray[np.float32]
    known: NDArray[np.bool_]


@device_function
def _difference(a, b, k, y, x):
    """Largest difference of a channel between a[y, x] and b[k, y, x]."""
    d0, d1, d2 = abs(a[y, x, 0] - b[k, y, x, 0]), abs(a[y, x, 1] - b[k, y, x, 1]), (abs(a[y, x, 2] - b[k, y, x, 2]))
    return max(d0, max(d1, d2))


@kernel
def compare_with_plate(counter, worker, blurred, plate, earlier, earlier_count, static, has_static, difference, flags):
    """Compare a blurred frame with the plate and with earlier frames. Tasks are runs of rows.

    blurred: float32 (H, W, 3). plate: ``PlateArrays``.
    earlier: float32 (2, H, W, 3), blurred earlier frames, of which the first ``earlier_count`` count.
    static: float32 (1, H, W, 3), the static field's rendering, blurred; read if ``has_static``.
    difference: float32 (H, W), written: difference from the plate, of the worst channel.
    flags: uint8 (H, W), written: FOREGROUND, CHANGING (differs from an earlier frame) and LIKE_STATIC.
    """
    height, width = difference.shape
    least, beyond = np.float32(tuned.THRESHOLD), np.float32(tuned.THRESHOLD_UNKNOWN)
    while True:
        top = fetch_add(counter, 1) * _ROWS
        if top >= height:
            return
        for y in range(top, min(top + _ROWS, height)):
            for x in range(width):
                d = _difference(blurred, plate.blurred, 0, y, x)
                limit = max(least, np.float32(tuned.DEVIATIONS) * plate.deviation[y, x])
                change = _F0
                for k in range(earlier_count):
                    change = max(change, _difference(blurred, earlier, k, y, x))
                changing = change > limit
                off = _difference(blurred, static, 0, y, x) if has_static else _F0
                unknown = off > beyond if has_static else changing
                foreground = d > limit if plate.known[y, x] else unknown
                like = has_static & (off <= least)
                difference[y, x] = d
                flags[y, x] = (
                    np.uint8(foreground) * FOREGROUND + np.uint8(changing) * CHANGING + np.uint8(like) * LIKE_STATIC
                )


@device_function
def _swap_modes(plate, y, x, a, b):
    w, u = plate.weight[a, y, x], plate.weight[b, y, x]
    plate.weight[a, y, x], plate.weight[b, y, x] = u, w
    for c in range(3):
        m, n = plate.means[a, y, x, c], plate.means[b, y, x, c]
        plate.means[a, y, x, c], plate.means[b, y, x, c] = n, m
        m, n = plate.blurred[a, y, x, c], plate.blurred[b, y, x, c]
        plate.blurred[a, y, x, c], plate.blurred[b, y, x, c] = n, m


@device_function
def _join(plate, y, x, image, blurred):
    """Add a vote to the nearest mode, or replace the lightest mode where none is near."""
    best, nearest = -1, np.float32(1e9)
    for k in range(MODES):
        if plate.weight[k, y, x] > np.float32(tuned.LEAST_WEIGHT):
            d = _difference(blurred, plate.blurred, k, y, x)
            if d < nearest:
                nearest, best = d, k
    if nearest > np.float32(tuned.THRESHOLD):
        best = 0
        for k in range(1, MODES):
            if plate.weight[k, y, x] < plate.weight[best, y, x]:
                best = k
        plate.weight[best, y, x], plate.run[y, x], rate = _F1, 1, _F1
    else:
        plate.weight[best, y, x] += _F1
        plate.run[y, x] = 0 if best == 0 else plate.run[y, x] + 1
        rate = max(_F1 / plate.weight[best, y, x], np.float32(tuned.SLOWEST_RATE))
    for c in range(3):
        plate.means[best, y, x, c] += rate * (np.float32(image[y, x, c]) - plate.means[best, y, x, c])
        plate.blurred[best, y, x, c] += rate * (blurred[y, x, c] - plate.blurred[best, y, x, c])
    if best > 0:
        if plate.run[y, x] >= tuned.RUN:
            plate.weight[best, y, x], plate.run[y, x] = plate.weight[0, y, x] + _F1, 0
        for k in range(best, 0, -1):
            if plate.weight[k, y, x] > plate.weight[k - 1, y, x]:
                _swap_modes(plate, y, x, k, k - 1)


@device_function
def _join_plate(plate, y, x, image, blurred):
    """Add a vote to the plate, where there is no other mode: the usual case."""
    weight = plate.weight[0, y, x] + _F1
    rate = max(_F1 / weight, np.float32(tuned.SLOWEST_RATE))
    plate.weight[0, y, x], plate.run[y, x] = weight, 0
    for c in range(3):
        plate.means[0, y, x, c] += rate * (np.float32(image[y, x, c]) - plate.means[0, y, x, c])
        plate.blurred[0, y, x, c] += rate * (blurred[y, x, c] - plate.blurred[0, y, x, c])


@device_function
def _is_known(weight, total):
    """A plate needs KNOWN_VOTES, or nearly all of fewer arrivals, and a share of all arrivals."""
    enough = min(np.float32(tuned.KNOWN_VOTES), np.float32(tuned.EARLY_SHARE) * total)
    return (weight >= enough) & (weight >= np.float32(tuned.KNOWN_SHARE) * total)


@kernel
def vote(counter, worker, image, blurred, difference, foreground, votes, held, plate, static, has_static, picture):
    """Update the plate by a frame. Tasks are runs of rows.

    image: uint8 (H, W, 3). blurred, difference: as in ``compare_with_plate``.
    foreground: uint8 (H, W), pixels that are not the plate: they do not count for its deviation.
    votes: uint8 (H, W), pixels that may be background.
    held: uint8 (H, W), pixels that neither vote nor forget.
    plate: ``PlateArrays``, updated.
    static: float32 (H, W, 3), the static field's rendering; read if ``has_static``.
    picture: float32 (H, W, 3), written: the plate; where that is unknown, the static field.
    """
    height, width = difference.shape
    decay, rate = np.float32(1.0 - 1.0 / tuned.MEMORY), np.float32(tuned.DEVIATION_RATE)
    while True:
        top = fetch_add(counter, 1) * _ROWS
        if top >= height:
            return
        for y in range(top, min(top + _ROWS, height)):
            for x in range(width):
                if held[y, x]:
                    plate.run[y, x] = 0
                else:
                    d, old = difference[y, x], plate.deviation[y, x]
                    limit = max(np.float32(tuned.THRESHOLD), np.float32(tuned.DEVIATIONS) * old)
                    if (foreground[y, x] == 0) & plate.known[y, x] & (d < np.float32(3.0) * limit):
                        plate.deviation[y, x] = old + (d - old) * rate
                    plate.total[y, x] = plate.total[y, x] * decay + _F1
                    least = np.float32(tuned.LEAST_WEIGHT)
                    for k in range(MODES):  # what is forgotten becomes 0: a processor is slow with subnormal numbers
                        weight = plate.weight[k, y, x] * decay
                        plate.weight[k, y, x] = weight if weight > least else _F0
                    alone = (plate.weight[1, y, x] <= least) & (plate.weight[2, y, x] <= least)
                    if votes[y, x] and alone and d <= np.float32(tuned.THRESHOLD) and plate.weight[0, y, x] > least:
                        _join_plate(plate, y, x, image, blurred)
                    elif votes[y, x]:
                        _join(plate, y, x, image, blurred)
                    else:
                        plate.run[y, x] = 0
                    plate.known[y, x] = _is_known(plate.weight[0, y, x], plate.total[y, x])
                for c in range(3):
                    shows_plate = plate.known[y, x] | (not has_static)
                    picture[y, x, c] = plate.means[0, y, x, c] if shows_plate else static[y, x, c]


@kernel
def count_exposure(counter, worker, image, plate, counts):
    """Count the pixels where a frame is brighter or darker than the plate, among every fourth pixel of the
    known and well exposed plate.

    counts: int64 (3, 3), written, for each channel: pixels, those brighter and those darker than the plate by
        more than GAIN_STEP.
    """
    if fetch_add(counter, 1) > 0:
        return
    counts[:] = 0
    high, low = np.float32(1.0 + tuned.GAIN_STEP), np.float32(1.0 - tuned.GAIN_STEP)
    for y in range(0, image.shape[0], 2):
        for x in range(0, image.shape[1], 2):
            m = plate.means[0, y, x]
            dark, bright = min(m[0], min(m[1], m[2])), max(m[0], max(m[1], m[2]))
            if plate.known[y, x] & (dark > np.float32(tuned.DARK)) & (bright < np.float32(tuned.BRIGHT)):
                for c in range(3):
                    value = np.float32(image[y, x, c])
                    counts[c, 0] += 1
                    counts[c, 1] += np.int64(value > high * m[c])
                    counts[c, 2] += np.int64(value < low * m[c])
