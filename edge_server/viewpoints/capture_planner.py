"""Plans a capture: takes the candidate with the best value for its way, again until the budget is used."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Field, View
from edge_server.viewpoints.candidates import Candidates, ViewpointError
from edge_server.viewpoints.registry import CaptureState, Selector

# Values that differ by less than this share of their size are equal.
_EQUAL = 1e-9
Take = Callable[[int], View | None]


@dataclass(frozen=True)
class Budget:
    """What a capture may spend: a number of views, meters of path, or both. ViewpointError for neither."""

    views: int | None = None
    path_m: float | None = None

    def __post_init__(self) -> None:
        if self.views is None and self.path_m is None:
            raise ViewpointError("a budget is a number of views, meters of path, or both")
        if self.views is not None and self.views < 1:
            raise ViewpointError(f"budget: expected at least 1 view, got {self.views}")
        if self.path_m is not None and not 0.0 <= self.path_m < np.inf:
            raise ViewpointError(f"budget: expected meters of path from 0, got {self.path_m:g}")


@dataclass(frozen=True)
class Stop:
    """A view of the plan.

    candidate: its number.
    value: the selector's value of it. travel_m: length of the way from the stop before.
    seconds: time to choose it. why: one line for people.
    values: values of all candidates when this one was chosen, NaN where closed.
    """

    candidate: int
    value: float
    travel_m: float
    seconds: float
    why: str
    values: NDArray[np.float64] = field(repr=False, compare=False, default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Plan:
    """What was chosen. refused: candidates that gave no picture. note: what people should know; may be
    empty."""

    selector: str
    stops: tuple[Stop, ...]
    views: tuple[View, ...]
    refused: tuple[int, ...] = ()
    note: str = ""

    @property
    def path_m(self) -> float:
        return float(sum(stop.travel_m for stop in self.stops))

    @property
    def order(self) -> list[int]:
        return [stop.candidate for stop in self.stops]

    def as_json(self, candidates: Candidates) -> dict[str, Any]:
        """plan.json: the stops with their poses, and what was left out."""
        stops = [
            {k: v for k, v in asdict(s).items() if k != "values"}
            | {"camera_to_world": candidates.poses[s.candidate].tolist()}
            for s in self.stops
        ]
        return {
            "selector": self.selector,
            "views": len(self.stops),
            "path_m": self.path_m,
            "stops": stops,
            "refused": list(self.refused),
            "candidates": len(candidates),
            "unreachable": np.flatnonzero(~candidates.reachable).tolist(),
            "note": self.note,
        }


def plan_capture(
    candidates: Candidates,
    selector: Selector,
    budget: Budget,
    take: Take,
    *,
    seed: int = 0,
    travel_weight: float = 0.0,
    fit: Callable[[list[View]], Field] | None = None,
) -> Plan:
    """Choose and take views one by one.

    take: takes the picture at a candidate; None: it was refused (the arm does not get there after all, the
        picture is spoilt). The camera then stays where it was, and refused views do not count.
    seed: determines the first view and what the selector draws.
    travel_weight: weight of the longest way to a candidate against the largest difference between two values,
        0 to any number; 0 chooses by value alone.
    fit: fits a field to views, for selectors that need one.

    Raises ViewpointError where no candidate is reachable, or every one is refused.
    """
    if not candidates.reachable.any():
        raise ViewpointError(
            f"none of the {len(candidates)} candidates can be reached: change the radius, the elevations, or "
            "where the robot's base stands"
        )
    rngs = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2)]
    reachable = np.flatnonzero(candidates.reachable)
    first = int(rngs[0].choice(reachable))
    state = CaptureState(candidates, budget.views or len(reachable), rngs[1], fit)
    stops: list[Stop] = []
    refused: list[int] = []
    free = candidates.reachable.copy()
    while len(stops) < state.views_wanted:
        travel = travel_m(candidates, stops[-1].candidate) if stops else np.zeros(len(candidates))
        left_m = np.inf if budget.path_m is None else budget.path_m - sum(s.travel_m for s in stops)
        state.open = free & (travel <= left_m)
        if not state.open.any():
            break
        began = time.perf_counter()
        if stops:
            k, stop = _choose(state, selector, travel, travel_weight)
        else:
            k = first if free[first] else int(rngs[0].choice(np.flatnonzero(free)))
            stop = Stop(k, 0.0, 0.0, 0.0, "the first view")
        seconds = time.perf_counter() - began
        free[k] = False
        view = take(k)
        if view is None:
            refused.append(k)
            continue
        stops.append(Stop(k, stop.value, stop.travel_m, seconds, stop.why, stop.values))
        state.order.append(k)
        state.views.append(view)
    if not stops:
        raise ViewpointError(
            f"all {len(refused)} reachable candidates were refused: is the camera working, and the way free?"
        )
    note = _note(candidates, budget, stops, refused)
    return Plan(selector.name, tuple(stops), tuple(state.views), tuple(refused), note)


def travel_m(candidates: Candidates, start: int) -> NDArray[np.float64]:
    """(N,) length of the way from candidate ``start`` to each one: round the target, not through it."""
    away = candidates.poses[:, :3, 3] - candidates.target
    far = np.linalg.norm(away, axis=1)
    cosine = np.clip(candidates.directions @ candidates.directions[start], -1.0, 1.0)
    arc = 0.5 * (far + far[start]) * np.arccos(cosine)
    way = np.hypot(arc, far - far[start])
    way[start] = 0.0  # the arc cosine of 1 - 1e-16 is 1e-8
    return way


def _choose(state: CaptureState, selector: Selector, travel: NDArray[np.float64], weight: float) -> tuple[int, Stop]:
    """The next candidate; where all are of equal value, the nearest one."""
    values = np.asarray(selector.values(state), np.float64)
    if values.shape != (len(state.candidates),):
        raise ViewpointError(
            f"selector {selector.name}: values of shape {values.shape} for {len(state.candidates)} candidates"
        )
    if not np.isfinite(values[state.open]).all():
        raise ViewpointError(f"selector {selector.name}: a value is not finite")
    low, high = values[state.open].min(), values[state.open].max()
    same = _equal(values[state.open])
    farthest = max(float(travel[state.open].max()), 1e-12)
    share = np.zeros(len(values)) if same else (values - low) / (high - low)
    total = share - (weight or float(same)) * travel / farthest
    k = int(np.argmax(np.where(state.open, total, -np.inf)))
    rank = int((values[state.open] > values[k]).sum()) + 1
    why = f"value {values[k]:.4g}, {rank}. of {int(state.open.sum())}; {travel[k]:.2f} m away"
    return k, Stop(k, float(values[k]), float(travel[k]), 0.0, why, np.where(state.open, values, np.nan))


def _equal(values: NDArray[np.float64]) -> bool:
    low, high = np.nanmin(values), np.nanmax(values)
    return bool(high - low <= _EQUAL * max(abs(low), abs(high), 1e-300))


def _note(candidates: Candidates, budget: Budget, stops: list[Stop], refused: list[int]) -> str:
    """What people should know of a plan, in sentences."""
    words = []
    lost = int((~candidates.reachable).sum())
    if lost:
        words.append(f"{lost} of {len(candidates)} candidates cannot be reached.")
    if refused:
        words.append(f"{len(refused)} views were refused.")
    if budget.views is not None and len(stops) < budget.views:
        used_up = budget.path_m is not None and len(stops) + len(refused) < int(candidates.reachable.sum())
        reason = "the path is used up" if used_up else "no candidate is left"
        words.append(f"Only {len(stops)} of {budget.views} views: {reason}.")
    if stops[1:] and all(_equal(stop.values) for stop in stops[1:]):
        words.append("All candidates were of equal value: the nearest one was taken each time.")
    return " ".join(words)
