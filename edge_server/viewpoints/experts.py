"""Simulated experts: they compare reconstructions by their pictures, so that studies run without people.

Their answers are never mixed with those of people: every record of an answer carries ``label``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.viewpoints.candidates import ViewpointError
from edge_server.viewpoints.preference_model import Answer
from edge_server.viewpoints.viewpoint_constants import DETAIL_PX, OBJECT_DIFFERS

Picture = NDArray[np.float32]


def edges(rendering: Picture, truth: Picture) -> float:
    """How well outlines agree with those of the truth: the gradients' mean difference, negated."""
    return -float(np.abs(_gradient(rendering) - _gradient(truth)).mean())


def whole_object(rendering: Picture, truth: Picture) -> float:
    """How well the object itself looks: the mean squared difference over its pixels, negated. The background
    is the color of the corners."""
    corners = np.stack([truth[0, 0], truth[0, -1], truth[-1, 0], truth[-1, -1]])
    shows = np.abs(truth - np.median(corners, axis=0)).max(axis=-1) > OBJECT_DIFFERS
    difference = ((rendering - truth) ** 2).mean(axis=-1)
    return -float(difference[shows].mean() if shows.any() else difference.mean())


def texture(rendering: Picture, truth: Picture) -> float:
    """How well fine detail is kept: the mean difference of what a blur removes, negated."""
    return -float(np.abs(_detail(rendering) - _detail(truth)).mean())


Taste = Callable[[Picture, Picture], float]
TASTES: dict[str, Taste] = {"edges": edges, "object": whole_object, "texture": texture}


@dataclass
class SimulatedExpert:
    """Answers by its taste and its habits.

    taste: one of ``TASTES``. scores: (N,), scores of the reconstructions, by ``judge``.
    rng: draws mistakes.
    wrong: share of answers that are the opposite of what the taste says.
    contradicts: whether it answers at random.
    """

    taste: str
    scores: NDArray[np.float64]
    rng: np.random.Generator
    wrong: float = 0.0
    contradicts: bool = False
    asked: list[Answer] = field(default_factory=list)

    @property
    def label(self) -> str:
        """Who answered, for every record and figure."""
        habits = [f"{100 * self.wrong:g} % wrong"] if self.wrong else []
        habits += ["contradicting"] if self.contradicts else []
        return f"simulated expert ({', '.join([self.taste, *habits])})"

    def answer(self, first: int, second: int) -> Answer:
        """Its answer to a pair, kept in ``asked``."""
        draw = self.rng.random(3)  # as many for every pair, whatever the habits: a seed keeps its answers
        prefers = bool(self.scores[first] >= self.scores[second]) != bool(draw[0] < self.wrong)
        if self.contradicts:
            prefers = bool(draw[2] < 0.5)
        self.asked.append(Answer(first, second, prefers))
        return self.asked[-1]


def judge(taste: str, renderings: Sequence[NDArray[Any]], truths: Sequence[NDArray[Any]]) -> float:
    """The score of one reconstruction, seen from several viewpoints: (H, W, 3) in [0, 1] each. Raises
    ViewpointError for an unknown taste."""
    if taste not in TASTES:
        raise ViewpointError(f"no expert has the taste {taste!r}; there are: {', '.join(TASTES)}")
    pairs = zip(renderings, truths, strict=True)
    found = [TASTES[taste](np.asarray(r, np.float32), np.asarray(t, np.float32)) for r, t in pairs]
    return float(np.mean(found))


def _gradient(picture: Picture) -> Picture:
    """(H, W) lengths of the brightness's gradient."""
    gray = picture.mean(axis=-1)
    return np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))


def _detail(picture: Picture) -> Picture:
    return picture - cv2.GaussianBlur(picture, (0, 0), DETAIL_PX)
