"""Procedural textures: colors (3, N) in [0, 1] as functions of surface coordinates (2, N).

All have soft edges or are sums of a few sinusoids, so that images of a hundred pixels a side alias little;
``supersample`` reduces it further. Widths are in the surface's units (meters, or turns around a round shape).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from freshfield.geometry import Array

Color = tuple[float, float, float]
Texture = Callable[[Array], Array]


def _rgb(color: Color) -> Array:
    return np.array(color, dtype=np.float64)[:, None]


def mix(a: Array, b: Array, weight: Array) -> Array:
    """a where weight is 0, b where it is 1; colors (3, N) or (3, 1), weight (N,)."""
    return a + (b - a) * weight


def soft_step(x: Array, width: float) -> Array:
    """0 below -width / 2, 1 above +width / 2, smooth between."""
    s = np.clip(x / width + 0.5, 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)


def soft_line(x: Array, period: float, thickness: float, soft: float) -> Array:
    """1 on lines of ``thickness`` at every multiple of ``period``, 0 between them."""
    distance = np.abs((x / period + 0.5) % 1.0 - 0.5) * period
    return 1.0 - soft_step(distance - 0.5 * thickness, soft)


def soft_square(x: Array, period: float, soft: float) -> Array:
    """A square wave between 0 and 1 with smooth flanks ``soft`` wide."""
    distance = np.abs((x / period) % 1.0 - 0.5) * period - 0.25 * period
    return soft_step(distance, soft)


def cell_hash(i: Array, j: Array) -> Array:
    """A fixed pseudo-random number in [0, 1) for each integer cell (any size, exact in uint64)."""
    a = i.astype(np.int64).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    b = j.astype(np.int64).astype(np.uint64) * np.uint64(0xC2B2AE3D27D4EB4F)
    h = a ^ (b + np.uint64(0x165667B19E3779F9))
    h = (h ^ (h >> np.uint64(31))) * np.uint64(0xBF58476D1CE4E5B9)
    h = h ^ (h >> np.uint64(29))
    return (h >> np.uint64(40)).astype(np.float64) / float(1 << 24)


@dataclass(frozen=True)
class Plain:
    color: Color

    def __call__(self, uv: Array) -> Array:
        return np.broadcast_to(_rgb(self.color), (3, uv.shape[1]))


@dataclass(frozen=True)
class Noise:
    """Multiplies ``base`` by 1 + amount * noise, where the noise, about +-1, is a fixed sum of plane waves no
    shorter than ``wavelength``."""

    base: Texture
    wavelength: float
    amount: float
    seed: int = 0
    waves: int = 9
    stretch: float = 1.0  # wavelengths along v are longer by this factor

    def __call__(self, uv: Array) -> Array:
        rng = np.random.default_rng([self.seed, 7])
        angle = rng.uniform(0, 2 * np.pi, self.waves)
        k = 2 * np.pi / (self.wavelength * rng.uniform(1.0, 3.0, self.waves))
        vectors = np.stack([k * np.cos(angle), k * np.sin(angle) / self.stretch], axis=1)
        phase = rng.uniform(0, 2 * np.pi, self.waves)[:, None]
        value = np.sin(vectors @ uv + phase).sum(axis=0) / np.sqrt(self.waves)
        return np.clip(self.base(uv) * (1.0 + self.amount * value), 0.0, 1.0)


@dataclass(frozen=True)
class Checker:
    a: Color
    b: Color
    size: float
    size_v: float | None = None
    soft: float = 0.02

    def __call__(self, uv: Array) -> Array:
        u = soft_square(uv[0], 2 * self.size, self.soft)
        v = soft_square(uv[1], 2 * (self.size_v or self.size), self.soft)
        return mix(_rgb(self.a), _rgb(self.b), u + v - 2 * u * v)


@dataclass(frozen=True)
class Stripes:
    """Stripes across u (axis 0) or v (axis 1), each ``period`` wide in all."""

    a: Color
    b: Color
    period: float
    axis: int = 0
    soft: float = 0.02

    def __call__(self, uv: Array) -> Array:
        return mix(_rgb(self.a), _rgb(self.b), soft_square(uv[self.axis], self.period, self.soft))


@dataclass(frozen=True)
class Brick:
    """Running bond with soft joints; each brick has its own tone."""

    brick: Color
    joint: Color
    width: float
    height: float
    joint_width: float = 0.035
    variation: float = 0.22
    soft: float = 0.025

    def __call__(self, uv: Array) -> Array:
        row = np.floor(uv[1] / self.height)
        u = uv[0] + 0.5 * self.width * (row % 2)
        column = np.floor(u / self.width)
        tone = 1.0 + self.variation * (cell_hash(column, row) * 2.0 - 1.0)
        line = np.maximum(
            soft_line(u, self.width, self.joint_width, self.soft),
            soft_line(uv[1], self.height, self.joint_width, self.soft),
        )
        return mix(np.clip(_rgb(self.brick) * tone, 0, 1), _rgb(self.joint), line)


@dataclass(frozen=True)
class Planks:
    """Boards along v, each with its own tone and a smooth grain."""

    light: Color
    dark: Color
    width: float
    length: float
    seam: float = 0.015
    soft: float = 0.02

    def __call__(self, uv: Array) -> Array:
        column = np.floor(uv[0] / self.width)
        v = uv[1] + self.length * cell_hash(column, column * 0)
        row = np.floor(v / self.length)
        tone = cell_hash(column, row + 17.0)
        grain = 0.5 + 0.5 * np.sin(
            2 * np.pi * (uv[0] / (0.45 * self.width) + 0.35 * np.sin(2.1 * v + 6.3 * tone) + tone)
        )
        weight = np.clip(0.75 * tone + 0.25 * grain, 0, 1)
        line = np.maximum(
            soft_line(uv[0], self.width, self.seam, self.soft), soft_line(v, self.length, self.seam, self.soft)
        )
        wood = mix(_rgb(self.light), _rgb(self.dark), weight)
        return wood * (1.0 - 0.45 * line)


@dataclass(frozen=True)
class Plaid:
    """Two crossing sets of bands over a ground color."""

    ground: Color
    band: Color
    thread: Color
    period_u: float
    period_v: float

    def __call__(self, uv: Array) -> Array:
        u = 0.5 - 0.5 * np.cos(2 * np.pi * uv[0] / self.period_u)
        v = 0.5 - 0.5 * np.cos(2 * np.pi * uv[1] / self.period_v)
        out = mix(_rgb(self.ground), _rgb(self.band), np.clip(0.6 * (u + v), 0, 1))
        return mix(out, _rgb(self.thread), (u**6 + v**6) * 0.45)


@dataclass(frozen=True)
class Diamonds:
    """A wallpaper of lozenges with a dot in each."""

    ground: Color
    lozenge: Color
    dot: Color
    width: float
    height: float
    soft: float = 0.18

    def __call__(self, uv: Array) -> Array:
        a, b = uv[0] / self.width, uv[1] / self.height
        u = np.abs((a + 0.5) % 1.0 - 0.5)
        v = np.abs((b + 0.5) % 1.0 - 0.5)
        out = mix(_rgb(self.lozenge), _rgb(self.ground), soft_step(u + v - 0.5, self.soft))
        return mix(_rgb(self.dot), out, soft_step(np.hypot(u, v) - 0.17, self.soft * 0.6))


@dataclass(frozen=True)
class Books:
    """Rows of book spines between shelf boards."""

    colors: Sequence[Color]
    shelf: Color
    width: float
    height: float
    board: float = 0.05
    soft: float = 0.02

    def __call__(self, uv: Array) -> Array:
        row = np.floor(uv[1] / self.height)
        column = np.floor(uv[0] / self.width + cell_hash(row, row))
        palette = np.array(self.colors).T
        pick = np.floor(cell_hash(column, row + 3.0) * palette.shape[1]).astype(int)
        spine = palette[:, pick] * (0.75 + 0.25 * cell_hash(column + 5.0, row))
        inside = (uv[1] / self.height) % 1.0
        top = 0.62 + 0.25 * cell_hash(column, row + 11.0)
        dark = _rgb(self.shelf) * 0.35
        spine = mix(spine, dark, soft_step(inside - top, 0.06))
        return mix(spine, _rgb(self.shelf), soft_line(uv[1], self.height, self.board, self.soft))


@dataclass(frozen=True)
class Gradient:
    """From ``low`` to ``high`` along v between v0 and v1."""

    low: Color
    high: Color
    v0: float
    v1: float

    def __call__(self, uv: Array) -> Array:
        return mix(_rgb(self.low), _rgb(self.high), np.clip((uv[1] - self.v0) / (self.v1 - self.v0), 0, 1))


@dataclass(frozen=True)
class Framed:
    """A picture within a frame of ``border`` on a rectangle of half sizes ``half``."""

    picture: Texture
    frame: Color
    half: tuple[float, float]
    border: float
    soft: float = 0.015

    def __call__(self, uv: Array) -> Array:
        inside = np.minimum(self.half[0] - np.abs(uv[0]), self.half[1] - np.abs(uv[1])) - self.border
        return mix(_rgb(self.frame), self.picture(uv), soft_step(inside, self.soft))


@dataclass(frozen=True)
class Spots:
    """Discs of given centers, radii and colors painted over a base texture."""

    base: Texture
    discs: Sequence[tuple[float, float, float, Color]]  # u, v, radius, color
    soft: float = 0.02

    def __call__(self, uv: Array) -> Array:
        out = self.base(uv)
        for u, v, radius, color in self.discs:
            away = np.hypot(uv[0] - u, uv[1] - v) - radius
            out = mix(_rgb(color), out, soft_step(away, self.soft))
        return out


@dataclass(frozen=True)
class Bands:
    """Rectangles (u0, u1, v0, v1, color) painted over a base texture, in order."""

    base: Texture
    rectangles: Sequence[tuple[float, float, float, float, Color]]
    soft: float = 0.01

    def __call__(self, uv: Array) -> Array:
        out = self.base(uv)
        for u0, u1, v0, v1, color in self.rectangles:
            inside = np.minimum(np.minimum(uv[0] - u0, u1 - uv[0]), np.minimum(uv[1] - v0, v1 - uv[1]))
            out = mix(out, _rgb(color), soft_step(inside, self.soft))
        return out
