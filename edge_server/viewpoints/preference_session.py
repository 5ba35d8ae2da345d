"""A session of comparisons: which pair of reconstructions is asked next, what was answered, and its file.

This module does no input or output: each answer gives a new session, which the caller keeps once it is
written. Every question follows from the seed and the answers before it, so that a session goes on where its
file ends.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from edge_server.viewpoints.candidates import ViewpointError
from edge_server.viewpoints.preference_model import Answer, RewardModel, fit_reward, random_pair
from edge_server.viewpoints.viewpoint_constants import REMEMBERED, REPEAT_EVERY

KIND: Literal["freshfield preference answers"] = "freshfield preference answers"
PERSON = "person"
Choice = Literal["left", "right", "neither"]
_SWAPPED = {"left": "right", "right": "left", "neither": "neither"}


class Given(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An answer.

    left, right: numbers of the reconstructions that were shown.
    choice: "neither" where no difference was seen.
    by: "person", or a simulated expert's label.
    repeats: number of the answer to the same pair with its sides swapped; None: a new pair.
    """

    left: int
    right: int
    choice: Choice
    by: str
    repeats: int | None = None


class AnswersFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The exported file. made_of: digest of all that determines the reconstructions. reconstructions: for
    each, the candidates whose views it was made of, in order."""

    kind: Literal["freshfield preference answers"]
    version: Literal[1]
    scenario: str
    seed: int
    made_of: str
    reconstructions: tuple[tuple[int, ...], ...]
    answers: tuple[Given, ...]


@dataclass(frozen=True)
class Question:
    """The reconstructions to show on either side. repeats: as in ``Given``."""

    left: int
    right: int
    repeats: int | None = None


@dataclass(frozen=True)
class PreferenceSession:
    """The state of one session.

    scenario: name of the reconstructions' scenario.
    orders: the views of each reconstruction, as in ``AnswersFile``.
    features: (N, d), features of the reconstructions as trajectories.
    wanted: number of questions.
    seed: determines the questions, with the answers.
    by: who answers, PERSON or the label of a simulated expert.
    made_of: as in ``AnswersFile``.

    Raises ViewpointError where there is no pair to ask about.
    """

    scenario: str
    orders: tuple[tuple[int, ...], ...]
    features: NDArray[np.float64] = field(compare=False)  # an array has no single truth value; orders say the same
    wanted: int = 60
    seed: int = 0
    by: str = PERSON
    answers: tuple[Given, ...] = ()
    made_of: str = ""

    def __post_init__(self) -> None:
        if len(set(self.orders)) < 2:
            raise ViewpointError(
                "no pair to ask about: there are not two reconstructions of different views; give more "
                "candidates, or fewer views each"
            )

    @cached_property
    def model(self) -> RewardModel:
        """The reward model of the answers. "neither" is half a vote for each side: y = 1/2 in (4.13)."""
        prefers_first = {"left": True, "right": False, "neither": None}
        return fit_reward(self.features, [Answer(a.left, a.right, prefers_first[a.choice]) for a in self.answers])

    @cached_property
    def question(self) -> Question | None:
        """The next question; None after the last."""
        n = len(self.answers)
        if n >= self.wanted:
            return None
        rng = np.random.default_rng([self.seed, n])
        again = {a.repeats for a in self.answers}
        new = [k for k, a in enumerate(self.answers) if a.repeats is None and k not in again]
        if n % REPEAT_EVERY == REPEAT_EVERY - 1 and new:
            k = int(rng.choice(new[: max(len(new) - REMEMBERED, 1)]))
            return Question(self.answers[k].right, self.answers[k].left, k)
        return Question(*random_pair(len(self.orders), rng))

    @property
    def agreement(self) -> tuple[int, int]:
        """(repeated pairs that were answered alike, all repeated pairs)."""
        pairs = [(a.choice, self.answers[a.repeats].choice) for a in self.answers if a.repeats is not None]
        return sum(_SWAPPED[now] == before for now, before in pairs), len(pairs)

    def answered(self, choice: Choice) -> PreferenceSession:
        """The session after this answer to ``question``. ViewpointError where none is open."""
        asked = self.question
        if asked is None:
            raise ViewpointError("all questions are answered")
        given = Given(asked.left, asked.right, choice, self.by, asked.repeats)
        return replace(self, answers=(*self.answers, given))

    def undone(self) -> PreferenceSession:
        """The session before the last answer, whose question is asked again; itself before the first."""
        return replace(self, answers=self.answers[:-1])

    def as_json(self) -> dict[str, Any]:
        """The file of answers."""
        file = AnswersFile(KIND, 1, self.scenario, self.seed, self.made_of, self.orders, self.answers)
        return dict(msgspec.to_builtins(file))

    def imported(self, data: bytes) -> PreferenceSession:
        """The session of a file of answers about these very reconstructions. ViewpointError for anything
        else."""
        try:
            file = msgspec.json.decode(data, type=AnswersFile)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise ViewpointError(f"not a file of answers: {error}") from None
        ours = (self.scenario, self.made_of, self.orders)
        if (file.scenario, file.made_of, file.reconstructions) != ours:
            raise ViewpointError(f"answers about other reconstructions (scenario {file.scenario:.80})")
        if file.seed < 0:
            raise ViewpointError(f"not a file of answers: seed {file.seed} is below 0")
        for n, a in enumerate(file.answers):
            if not (0 <= a.left < len(self.orders) and 0 <= a.right < len(self.orders)) or a.left == a.right:
                raise ViewpointError(f"answer {n}: {a.left} and {a.right} are no pair of reconstructions")
            if a.by != self.by:
                raise ViewpointError(f"answer {n} is by {a.by:.80}, the others by {self.by}: they are not mixed")
            if a.repeats is not None:
                earlier = file.answers[a.repeats] if 0 <= a.repeats < n else None
                if earlier is None or (earlier.left, earlier.right) != (a.right, a.left):
                    raise ViewpointError(f"answer {n}: does not repeat answer {a.repeats} with sides swapped")
        return replace(self, answers=file.answers, seed=file.seed)
