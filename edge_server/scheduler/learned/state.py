"""The state that a decision is made from: semantics, ages and poses of all cameras, s_t = [Z Delta P] (6.33).

``State`` holds measured values; ``StateLayout`` turns them into features for a network: always finite, the
same scale for every part, and zeros with a cleared mask bit for a camera that never reported.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge_server.scheduler.learned import learning_constants as tuned

if TYPE_CHECKING:
    from freshfield.frame import Frame

STATE_PARTS = ("semantics", "age", "pose")
"""Parts of the state that a learned policy may look at, in the order of (6.33)."""


POSE_WIDTH = 6


@dataclass(frozen=True)
class State:
    """The cameras at one instant, one row each, whether they have reported or not.

    ages_ms: (N,) age of the newest frame (5.5); any value where nothing was reported.
    poses: (N, 6) translation from the rig's center in units of its size, then the rotation vector in radians.
    embeddings: (N, d) of the newest frames (6.31); rows that are not finite are unknown; None: not computed.
    reported: (N,) whether there is a newest frame.
    cameras: names of the rows; may be empty.
    frames: the newest frames by camera, still encoded, for explanations; empty unless asked for.
    """

    ages_ms: NDArray[np.float64]
    poses: NDArray[np.float64]
    embeddings: NDArray[np.float32] | None
    reported: NDArray[np.bool_]
    cameras: tuple[str, ...] = ()
    frames: Mapping[str, Frame] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.ages_ms)
        shapes = {"ages_ms": (n,), "poses": (n, POSE_WIDTH), "reported": (n,)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"state: {name} has shape {getattr(self, name).shape}, expected {shape}")
        if self.embeddings is not None and (self.embeddings.ndim != 2 or len(self.embeddings) != n):
            raise ValueError(f"state: embeddings of shape {self.embeddings.shape} for {n} cameras")
        if self.cameras and len(self.cameras) != n:
            raise ValueError(f"state: {len(self.cameras)} names for {n} cameras")

    def __len__(self) -> int:
        return len(self.ages_ms)


@dataclass(frozen=True)
class StateLayout:
    """Which parts a network sees, and their scales.

    parts: any of ``STATE_PARTS``.
    dim: width d of an embedding; 0 without semantics.
    age_scale_ms: ages enter as log(1 + age / scale): fine where ages differ by a frame, coarse for very old
    ones.
    oldest_ms: ages are clipped to it.
    center, spread: (d,) mean and standard deviation of embeddings, from ``standardized``; empty: used
    unscaled.
    embedding: name of the embedder the policy was trained with; empty: not specified.
    """

    parts: tuple[str, ...] = ("age", "pose", "semantics")
    dim: int = 0
    age_scale_ms: float = tuned.AGE_SCALE_MS
    oldest_ms: float = tuned.OLDEST_MS
    center: tuple[float, ...] = ()
    spread: tuple[float, ...] = ()
    embedding: str = ""

    def __post_init__(self) -> None:
        if unknown := set(self.parts) - set(STATE_PARTS):
            raise ValueError(f"state: no part is called {', '.join(unknown)}; there are {', '.join(STATE_PARTS)}")
        if not self.parts:
            raise ValueError(f"state: no parts; choose some of {', '.join(STATE_PARTS)}")
        require_int("state: dim", self.dim, 0, tuned.MAX_STATE_DIM)
        if ("semantics" in self.parts) != (self.dim > 0):
            raise ValueError(f"state: dim {self.dim} with parts {', '.join(self.parts)}: semantics has a dim")
        if not (0 < self.age_scale_ms < np.inf and 0 < self.oldest_ms < np.inf):
            raise ValueError("state: age_scale_ms and oldest_ms must be positive and finite")
        if not len(self.center) == len(self.spread) in (0, self.dim):
            raise ValueError(f"state: center and spread of embeddings must have {self.dim} values, or none")
        if not (np.isfinite(self.center).all() and all(0.0 < s < np.inf for s in self.spread)):
            raise ValueError("state: center of embeddings must be finite, spread positive and finite")

    @property
    def columns(self) -> dict[str, slice]:
        """Columns of every part in use. The last column of all is the mask bit."""
        widths = {"semantics": self.dim, "age": 1, "pose": POSE_WIDTH}
        out, at = {}, 0
        for part in STATE_PARTS:
            if part in self.parts:
                out[part] = slice(at, at + widths[part])
                at += widths[part]
        return out

    @property
    def width(self) -> int:
        """Number of columns: those of the parts, and the mask bit, 1 for a camera that has reported."""
        return max(columns.stop for columns in self.columns.values()) + 1

    def features(self, state: State) -> NDArray[np.float64]:
        """(N, width), finite for any state. A camera whose age is NaN counts as one that never reported.
        Raises ValueError if semantics are needed and the state has none, or of another width."""
        known = state.reported & ~np.isnan(state.ages_ms)
        out = np.zeros((len(state), self.width))
        for part, columns in self.columns.items():
            out[:, columns] = getattr(self, f"_{part}")(state)
        out[:, -1] = 1.0
        out[~known] = 0.0
        return out

    def batch(self, states: Sequence[State]) -> NDArray[np.float64]:
        """(B, N, width) of states with up to N cameras, padded with cameras that never reported."""
        n = max((len(state) for state in states), default=0)
        out = np.zeros((len(states), n, self.width))
        for row, state in zip(out, states):
            row[: len(state)] = self.features(state)
        return out

    def standardized(self, embeddings: NDArray[np.float64]) -> StateLayout:
        """The layout with which these ``embeddings`` (n, dim) have mean 0 and standard deviation 1: what all frames
        have in common does not inform a decision. Rows that are not finite are ignored; with fewer than two, itself."""
        rows = embeddings[np.isfinite(embeddings).all(axis=1)]
        if len(rows) < 2:
            return self
        spread = np.maximum(rows.std(axis=0), tuned.MIN_SPREAD * max(1.0, float(np.abs(rows).max())))
        return replace(self, center=tuple(rows.mean(axis=0).tolist()), spread=tuple(spread.tolist()))

    def _age(self, state: State) -> NDArray[np.float64]:
        # A camera whose clock is ahead has age 0. NaN rows are masked by the caller.
        ages = np.clip(np.nan_to_num(state.ages_ms, nan=0.0, posinf=self.oldest_ms), 0.0, self.oldest_ms)
        return np.log1p(ages / self.age_scale_ms)[:, None]

    def _pose(self, state: State) -> NDArray[np.float64]:
        poses = np.nan_to_num(state.poses, nan=0.0, posinf=tuned.FEATURE_LIMIT, neginf=-tuned.FEATURE_LIMIT)
        return np.clip(poses, -tuned.FEATURE_LIMIT, tuned.FEATURE_LIMIT)

    def _semantics(self, state: State) -> NDArray[np.float64]:
        if state.embeddings is None:
            raise ValueError("state: semantics are needed, but embeddings are not computed here")
        if state.embeddings.shape[1] != self.dim:
            raise ValueError(f"state: embeddings of width {state.embeddings.shape[1]}, expected {self.dim}")
        z = state.embeddings.astype(np.float64)
        unknown = ~np.isfinite(z).all(axis=1)
        z[unknown] = 0.0
        if self.center:
            z = (z - np.array(self.center)) / np.array(self.spread)
            z[unknown] = 0.0
        # A whole embedding initially weighs as much as one other feature; otherwise its d features drown the
        # age.
        return np.clip(z, -tuned.FEATURE_LIMIT, tuned.FEATURE_LIMIT) / np.sqrt(self.dim)


def require_int(name: str, value: object, least: int, most: int) -> None:
    """ValueError unless ``value`` is an int from ``least`` to ``most``; 64.0 is not one."""
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise ValueError(f"{name}: expected a whole number from {least} to {most}, got {value!r}")
