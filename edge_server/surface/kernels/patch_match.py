"""Photo-consistent depth: multi-view PatchMatch over slanted planes (Bleyer 2011, Galliani 2015).

Every pixel holds a plane: depth along its ray and normal. In turns, the pixels of one color of a chessboard
try the planes of neighbors and random changes of their own, and keep the cheapest. The cost of a plane is how
much the pixel's patch differs from the other images where the plane maps it (affine approximation).

Two measures are added. Normalized cross-correlation is invariant to exposure, but blind where brightness only
changes evenly: an even slope correlates with itself wherever it is shifted to. The difference of gray levels
is not, and on surfaces that only shading varies it alone locates the surface.
"""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.simd import exp32, fetch_add, uniform
from edge_server.surface import surface_constants as tuned
from edge_server.surface.kernels.patch_images import depth_shown, offset_to, project, within

LANES = 32  # taps of a patch: 5 x 5 and four farther ones; the rest weigh nothing
PATCH_RADIUS_PX = 3  # from the middle of a patch to its farthest tap


@kernel
def choose_sources(counter, worker, images, view, planes):
    """Writes ``view.chosen``: the images that show a pixel's point best, by the angle between the lines of
    sight and at the surface. Tasks are rows."""
    height, width = planes.depth.shape
    k = view.index
    ox, oy, oz = images.origin[k, 0], images.origin[k, 1], images.origin[k, 2]
    score, index = np.empty(tuned.SOURCES), np.empty(tuned.SOURCES, np.int64)
    while True:
        row = fetch_add(counter, 1)
        if row >= height:
            return
        for column in range(width):
            for i in range(tuned.SOURCES):
                score[i], index[i] = 0.0, -1
            d = np.float64(planes.depth[row, column])
            if d > 0.0:
                rx, ry, rz = view.rays[row, column, 0], view.rays[row, column, 1], view.rays[row, column, 2]
                nx = np.float64(planes.normal[row, column, 0])
                ny = np.float64(planes.normal[row, column, 1])
                nz = np.float64(planes.normal[row, column, 2])
                x, y, z = ox + d * rx, oy + d * ry, oz + d * rz
                for s in range(images.first.size - 1):
                    u, v = project(images, s, x, y, z)
                    if s == k or not within(images, s, u, v, PATCH_RADIUS_PX):
                        continue
                    ex, ey, ez, far = offset_to(images, s, x, y, z)
                    cosine = min(1.0, max(-1.0, (ex * rx + ey * ry + ez * rz) / far))
                    apart = np.degrees(np.arccos(cosine))
                    if not (apart >= tuned.LEAST_DEG and apart <= tuned.MOST_DEG):
                        continue
                    off = (apart - tuned.BEST_DEG) / tuned.SPREAD_DEG
                    facing = -(ex * nx + ey * ny + ez * nz) / far
                    good = np.exp(-0.5 * off * off) * min(1.0, max(tuned.FACING * facing, tuned.FACING_LEAST))
                    if good > score[tuned.SOURCES - 1]:
                        i = tuned.SOURCES - 1
                        while i > 0 and good > score[i - 1]:
                            score[i], index[i] = score[i - 1], index[i - 1]
                            i -= 1
                        score[i], index[i] = good, s
            for i in range(tuned.SOURCES):
                view.chosen[row, column, i] = index[i]


@device_function
def _pattern(across, down, fade):
    """Write the taps' offsets, pixels, and weights by distance, float32 (LANES,) each."""
    t = 0
    for j in range(-PATCH_RADIUS_PX, PATCH_RADIUS_PX + 1):
        for i in range(-PATCH_RADIUS_PX, PATCH_RADIUS_PX + 1):
            if (abs(i) < PATCH_RADIUS_PX and abs(j) < PATCH_RADIUS_PX) or i == 0 or j == 0:
                across[t], down[t] = i, j
                fade[t] = np.exp(-tuned.FADE * (i * i + j * j))
                t += 1
    for k in range(t, LANES):
        across[k] = down[k] = fade[k] = 0.0


@device_function
def _take_patch(gray, row, column, across, down, fade, patch, weight):
    """Write a pixel's patch, less its weighted mean, and its weights; returns sum of weights, mean and
    variance. Taps similar to the middle weigh more, taps outside nothing."""
    height, width = gray.shape
    total = mean = spread = np.float32(0.0)
    for t in range(LANES):
        r, c = row + np.int64(down[t]), column + np.int64(across[t])
        g, w = np.float32(0.0), np.float32(0.0)
        if r >= 0 and c >= 0 and r < height and c < width:
            g = gray[r, c]
            w = exp32(-abs(g - gray[row, column]) / tuned.SIMILAR) * fade[t]
        patch[t], weight[t] = g, w
        total += w
        mean += w * g
    mean /= total
    for t in range(LANES):
        patch[t] -= mean
        spread += weight[t] * patch[t] * patch[t]
    return total, mean, spread / total


@device_function
def plane_cost(images, view, row, column, d, nx, ny, nz, across, down, patch, weight, facts, geometric):
    """Cost of the plane through depth d with a normal: mean of the two images that differ least; and how many
    of these there are: 0 (the cost is WORST), 1 or 2. facts: what ``_take_patch`` returned for the pixel."""
    k, rays = view.index, view.rays
    height, width = view.gray.shape
    total, mean, spread = facts
    # A pixel to the right and one down, or their opposites at the border.
    right, below = 1 if column < width - 1 else -1, 1 if row < height - 1 else -1
    rx, ry, rz = rays[row, column, 0], rays[row, column, 1], rays[row, column, 2]
    along = nx * rx + ny * ry + nz * rz
    if not along < -tuned.LEAST_COS:
        return tuned.WORST, 0
    ax, ay, az = rays[row, column + right, 0], rays[row, column + right, 1], rays[row, column + right, 2]
    bx, by, bz = rays[row + below, column, 0], rays[row + below, column, 1], rays[row + below, column, 2]
    a, b = d * along / (nx * ax + ny * ay + nz * az), d * along / (nx * bx + ny * by + nz * bz)
    if not (a > 0.0 and b > 0.0 and a < 2.0 * d and b < 2.0 * d):
        return tuned.WORST, 0
    ox, oy, oz = images.origin[k, 0], images.origin[k, 1], images.origin[k, 2]
    x, y, z = ox + d * rx, oy + d * ry, oz + d * rz
    ax, ay, az = ox + a * ax, oy + a * ay, oz + a * az
    bx, by, bz = ox + b * bx, oy + b * by, oz + b * bz
    one, two = tuned.WORST, tuned.WORST
    levels = tuned.LEVELS + np.sqrt(spread)  # where texture is strong, so is what interpolation does to it
    for i in range(tuned.SOURCES):
        s = np.int64(view.chosen[row, column, i])
        if s < 0:
            break
        u, v = project(images, s, x, y, z)
        ur, vr = project(images, s, ax, ay, az)
        ud, vd = project(images, s, bx, by, bz)
        ux, vx, uy, vy = right * (ur - u), right * (vr - v), below * (ud - u), below * (vd - v)
        margin = 1.0 + PATCH_RADIUS_PX * max(abs(ux) + abs(uy), abs(vx) + abs(vy))
        if not within(images, s, u, v, margin):
            continue
        u0, v0 = np.float32(u - 0.5), np.float32(v - 0.5)
        fux, fvx, fuy, fvy = np.float32(ux), np.float32(vx), np.float32(uy), np.float32(vy)
        stride, first = np.int32(images.size[s, 0]), np.uint32(images.first[s])
        level = square = cross = change = np.float32(0.0)
        for t in range(LANES):
            p, q = u0 + across[t] * fux + down[t] * fuy, v0 + across[t] * fvx + down[t] * fvy
            px, py = np.int32(p), np.int32(q)
            fa, fb = p - np.float32(px), q - np.float32(py)
            at = np.uint32(first + np.uint32(py * stride + px))
            under = np.uint32(at + np.uint32(stride))
            top = images.gray[at] + fa * (images.gray[np.uint32(at + np.uint32(1))] - images.gray[at])
            low = images.gray[under]
            low += fa * (images.gray[np.uint32(under + np.uint32(1))] - low)
            g = top + fb * (low - top) - mean
            w = weight[t]
            level += w * g
            square += w * g * g
            cross += w * g * patch[t]
            change += w * abs(g - patch[t])
        other = max(square - level * level / total, np.float32(0.0)) / total
        like = cross / total / np.sqrt((spread + tuned.NOISE) * (other + tuned.NOISE))
        cost = (np.float32(1.0) - tuned.DIFFERENCE) * (np.float32(1.0) - like)
        cost += tuned.DIFFERENCE * min(change / total / levels, tuned.MOST_LEVELS)
        if geometric > 0.0:
            cost += np.float32(geometric * _way_back(images, k, s, row, column, u, v, x, y, z))
        if cost < one:
            one, two = cost, one
        elif cost < two:
            two = cost
    if two < tuned.WORST:
        return np.float32(0.5) * (one + two), 2
    return one, 1 if one < tuned.WORST else 0


@device_function
def _way_back(images, k, s, row, column, u, v, x, y, z):
    """Pixels between a pixel of image k and where the depth of image s, in which its point (x, y, z) is at
    (u, v), leads back to; MOST_PX at most."""
    shown = depth_shown(images, s, u, v)
    if not shown > 0.0:
        return tuned.MOST_PX
    ex, ey, ez, far = offset_to(images, s, x, y, z)
    far = shown / far
    ox, oy, oz = images.origin[s, 0], images.origin[s, 1], images.origin[s, 2]
    u, v = project(images, k, ox + far * ex, oy + far * ey, oz + far * ez)
    u, v = u - column - 0.5, v - row - 0.5
    return min(tuned.MOST_PX, np.sqrt(u * u + v * v))


@device_function
def _neighbor(planes, row, column, way):
    """The cheapest pixel of the other color in one of 8 ways, four near and four far; -1: none."""
    height, width = planes.depth.shape
    dr = 1 if way % 4 == 0 else -1 if way % 4 == 1 else 0
    dc = 1 if way % 4 == 2 else -1 if way % 4 == 3 else 0
    least, found_row, found_column = tuned.WORST, -1, -1
    for m in range(3 if way < 4 else 5):
        ahead = 3 + 2 * m if way >= 4 else 1 if m == 0 else 2
        aside = 0 if way >= 4 or m == 0 else 2 * m - 3
        r, c = row + dr * ahead + dc * aside, column + dc * ahead + dr * aside
        if r < 0 or c < 0 or r >= height or c >= width:
            continue
        if planes.depth[r, c] > 0.0 and planes.cost[r, c] < least:
            least, found_row, found_column = planes.cost[r, c], r, c
    return found_row, found_column


@kernel
def match(counter, worker, images, view, guess, planes, parity, key, search):
    """One pass over the pixels of one color of the chessboard. Tasks are rows.

    guess: float32 (H, W), initial depth; no depth leaves ``reach`` around it.
    planes: updated. parity: 1 for the pixels whose row + column is odd, else 0.
    key: uint64, stream of the pass's random numbers, which depend on the pixel alone.
    """
    height, width = planes.depth.shape
    across, down, fade = np.empty(LANES, np.float32), np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    patch, weight = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    meets, nearness, normals = np.empty(8), np.empty(8, np.float32), np.empty((8, 3))
    step = 1.0 / min(images.lens[view.index, 0], images.lens[view.index, 1])
    _pattern(across, down, fade)
    while True:
        row = fetch_add(counter, 1)
        if row >= height:
            return
        for column in range((row + parity) % 2, width, 2):
            d = np.float64(planes.depth[row, column])
            if not d > 0.0 or view.chosen[row, column, 0] < 0:
                continue
            facts = _take_patch(view.gray, row, column, across, down, fade, patch, weight)
            rx, ry, rz = view.rays[row, column, 0], view.rays[row, column, 1], view.rays[row, column, 2]
            nx = np.float64(planes.normal[row, column, 0])
            ny = np.float64(planes.normal[row, column, 1])
            nz = np.float64(planes.normal[row, column, 2])
            middle = np.float64(guess[row, column])
            # Where the planes of neighbors meet the ray, and how much each counts: 0 across an edge.
            total = np.float32(0.0)
            for way in range(8):
                meets[way] = nearness[way] = 0.0
                r, c = _neighbor(planes, row, column, way)
                if r < 0:
                    continue
                qx, qy = np.float64(planes.normal[r, c, 0]), np.float64(planes.normal[r, c, 1])
                qz = np.float64(planes.normal[r, c, 2])
                along = qx * rx + qy * ry + qz * rz
                if not along < -tuned.LEAST_COS:
                    continue
                there = qx * view.rays[r, c, 0] + qy * view.rays[r, c, 1] + qz * view.rays[r, c, 2]
                meets[way] = np.float64(planes.depth[r, c]) * there / along
                normals[way, 0], normals[way, 1], normals[way, 2] = qx, qy, qz
                nearness[way] = exp32(-abs(view.gray[r, c] - view.gray[row, column]) / tuned.SIMILAR)
                total += nearness[way]
            pixel = 1.0 / (middle * step)
            least = tuned.WORST
            # Trial 0: the pixel's own plane; 1 to 8: of neighbors; then random ones, then random changes.
            for trial in range(15 + search.wide):
                n = np.uint64(((row * width + column) * 64 + trial + 1) * 4)
                qd, qx, qy, qz = d, nx, ny, nz
                if trial >= 1 and trial <= 8:
                    qd = meets[trial - 1]
                    qx, qy, qz = normals[trial - 1, 0], normals[trial - 1, 1], normals[trial - 1, 2]
                elif trial > 8:
                    wide = trial < 9 + search.wide
                    small = tuned.SMALLER if trial >= 12 + search.wide else 1.0
                    kind = -1 if wide else (trial - search.wide) % 3  # 0: depth, 1: normal, 2: both
                    if kind != 1:
                        drawn = 2.0 * np.float64(uniform(key, n)) - 1.0
                        qd = middle * (1.0 + search.reach * drawn) if wide else d * (1.0 + small * search.share * drawn)
                    if kind != 0:
                        turn = 1.0 if wide else small * search.turn
                        keep = 0.0 if wide else 1.0
                        qx = keep * nx + turn * (2.0 * np.float64(uniform(key, n + np.uint64(1))) - 1.0)
                        qy = keep * ny + turn * (2.0 * np.float64(uniform(key, n + np.uint64(2))) - 1.0)
                        qz = keep * nz + turn * (2.0 * np.float64(uniform(key, n + np.uint64(3))) - 1.0)
                        length = np.sqrt(qx * qx + qy * qy + qz * qz)
                        if not length > 1e-3:
                            continue
                        length = -length if qx * rx + qy * ry + qz * rz > 0.0 else length
                        qx, qy, qz = qx / length, qy / length, qz / length
                if not abs(qd - middle) <= search.reach * middle:
                    continue
                cost, shown = plane_cost(
                    images, view, row, column, qd, qx, qy, qz, across, down, patch, weight, facts, search.geometric
                )
                if shown == 1:
                    cost = min(cost + tuned.SINGLE, tuned.WORST)
                if total > np.float32(0.0):
                    bumpy = np.float32(0.0)
                    for way in range(8):
                        bumpy += nearness[way] * np.float32(min(pixel * abs(qd - meets[way]), tuned.BUMPY_PX))
                    cost += tuned.SMOOTH * bumpy / (total + np.float32(1.0))
                if trial == 0 or cost < least - tuned.BETTER:
                    least, d, nx, ny, nz = cost, qd, qx, qy, qz
            planes.depth[row, column], planes.cost[row, column] = d, least
            planes.normal[row, column, 0] = nx
            planes.normal[row, column, 1] = ny
            planes.normal[row, column, 2] = nz


@kernel
def confirm(counter, worker, images, view, planes, share, agree, against, rise):
    """Collect the evidence for each plane. Tasks are rows.

    share: tolerance, as a share of the distance; one pixel is added.
    agree, against: int16 (H, W), written: number of chosen images whose depth agrees with the point, and of
        those that look through it.
    rise: float32 (H, W), written: mean rise of the (photometric) cost at depths one pixel's width nearer and
        farther; 0 where images tell nothing.
    """
    height, width = planes.depth.shape
    k = view.index
    across, down, fade = np.empty(LANES, np.float32), np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    patch, weight = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    _pattern(across, down, fade)
    while True:
        row = fetch_add(counter, 1)
        if row >= height:
            return
        for column in range(width):
            agree[row, column] = against[row, column] = rise[row, column] = 0
            d = np.float64(planes.depth[row, column])
            if not d > 0.0 or view.chosen[row, column, 0] < 0:
                continue
            x = images.origin[k, 0] + d * view.rays[row, column, 0]
            y = images.origin[k, 1] + d * view.rays[row, column, 1]
            z = images.origin[k, 2] + d * view.rays[row, column, 2]
            for i in range(tuned.SOURCES):
                s = np.int64(view.chosen[row, column, i])
                if s < 0:
                    break
                u, v = project(images, s, x, y, z)
                if not within(images, s, u, v, 0):
                    continue
                shown = depth_shown(images, s, u, v)
                _, _, _, far = offset_to(images, s, x, y, z)
                tolerance = (share + 1.0 / min(images.lens[s, 0], images.lens[s, 1])) * far
                if abs(shown - far) <= tolerance:
                    agree[row, column] += 1
                elif shown > far + tuned.THROUGH * tolerance:
                    against[row, column] += 1
            facts = _take_patch(view.gray, row, column, across, down, fade, patch, weight)
            nx = np.float64(planes.normal[row, column, 0])
            ny = np.float64(planes.normal[row, column, 1])
            nz = np.float64(planes.normal[row, column, 2])
            step = 1.0 / min(images.lens[k, 0], images.lens[k, 1])
            total, compared = np.float32(0.0), True
            for trial in range(3):
                near = d * (1.0 + step * (trial - 1))
                cost, shown = plane_cost(
                    images, view, row, column, near, nx, ny, nz, across, down, patch, weight, facts, 0.0
                )
                total += -cost if trial == 1 else np.float32(0.5) * cost
                compared = compared and shown > 0
            rise[row, column] = total if compared else np.float32(0.0)
