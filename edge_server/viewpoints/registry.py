"""Selectors by name. A selector looks at a capture under way and values each candidate viewpoint."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Field, View
from edge_server.viewpoints.candidates import Candidates, ViewpointError
from freshfield import plugins

# name -> (module, class, one line of help)
SELECTORS: dict[str, tuple[str, str, str]] = {
    "random": ("geometric", "RandomOrder", "any candidate, uniformly at random"),
    "coverage": ("geometric", "Coverage", "sees most of the object's box that is still unseen; needs no images"),
    "fisher": ("fisher", "FisherRF", "most Fisher information about the Gaussians fitted so far (FisherRF)"),
    "ppo": ("policy", "CandidatePolicy", "ppo:FILE: a policy learned from preferences (--ask, study preferences)"),
}


@dataclass
class CaptureState:
    """A capture under way, the state s_t of 4.5.2.

    candidates: all of them.
    views_wanted: number of views to capture, the budget's or that of all reachable candidates.
    order: numbers of the candidates captured so far, in this order. views: what was captured, likewise.
    open: (N,) candidates that may be chosen now: reachable, not captured, not refused, within the budget.
    rng: for selectors that draw.
    fit: fits a field to ``views``; called by ``field`` where a selector needs one.
    """

    candidates: Candidates
    views_wanted: int
    rng: np.random.Generator
    fit: Callable[[list[View]], Field] | None = None
    order: list[int] = field(default_factory=list)
    views: list[View] = field(default_factory=list)
    open: NDArray[np.bool_] = field(init=False)
    _fitted: tuple[int, Field] | None = None

    def __post_init__(self) -> None:
        self.open = self.candidates.reachable.copy()

    def field(self) -> Field:
        """A field fitted to the views so far, at most once a view. ViewpointError where nothing fits one."""
        if self.fit is None:
            raise ViewpointError("this selector needs a field of the views so far, and nothing fits one")
        if self._fitted is None or self._fitted[0] != len(self.views):
            self._fitted = len(self.views), self.fit(self.views)
        return self._fitted[1]


class Selector(Protocol):
    """Chooses viewpoints. name: as the commands know it."""

    name: str

    def values(self, state: CaptureState) -> NDArray[np.float64]:
        """The value of each candidate, (N,), in any unit, higher is better. Read where ``state.open``."""
        ...


def make_selector(name: str) -> Selector:
    """The named selector, whose module is imported only now. ``NAME:FILE`` hands FILE on to it. name:
    as in SELECTORS, or a class from outside (``freshfield.plugins``). Raises ViewpointError for an unknown name."""
    base, _, file = name.partition(":")
    if base not in SELECTORS:
        base, file = plugins.split_value(name)
    if base in SELECTORS:
        module, cls, _ = SELECTORS[base]
        made: Any = getattr(importlib.import_module(f"edge_server.viewpoints.{module}"), cls)
    else:
        try:
            made = plugins.find("selector", base, SELECTORS)
        except plugins.PluginError as error:
            raise ViewpointError(str(error)) from None
    if bool(file) != hasattr(made, "from_file"):
        raise ViewpointError(f"selector {name}: {'it takes no file' if file else f'expected {base}:FILE'}")
    selector: Selector = made.from_file(file) if file else made()
    return selector
