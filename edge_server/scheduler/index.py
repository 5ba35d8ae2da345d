"""Index policies: they select the k cameras with the largest index, which compares the frame of a camera that
was used last with its newest one. Cameras without a used frame come first."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from edge_server.scheduler.policy import Epoch, Policy, SelectionWindow

Embedding = NDArray[np.float32]


class IndexPolicy(Policy):
    """Base of index policies; a subclass defines the index of a camera."""

    parameter = "k"
    value: int = 6

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        super().__init__(value, rng)
        self._used_ns: dict[str, int] = {}

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        self._look(epoch)

        def index(camera: str) -> float:
            used_ns = self._used_ns.get(camera)
            if used_ns is None:
                return math.inf
            return self._index(camera, (epoch.now_ns - used_ns) / 1e6, epoch.age_ms(camera))

        chosen = set(sorted(epoch.generated_ns, key=index, reverse=True)[: self.value])
        self._used_ns |= {c: epoch.generated_ns[c] for c in chosen}
        self._use(chosen)
        return tuple(c for c in epoch.generated_ns if c in chosen)

    def _index(self, camera: str, known_ms: float, age_ms: float) -> float:
        """known_ms: age of the camera's frame that was used last. age_ms: age of its newest frame."""
        raise NotImplementedError

    def _look(self, epoch: Epoch) -> None:
        """Called before the indices are computed."""

    def _use(self, cameras: set[str]) -> None:
        """Called with the selected cameras, whose newest frames are now used."""


class Whittle(IndexPolicy):
    """Whittle-type index: selects the k views that most reduce the squared ages of the frames used last.

    A camera's index is (D^2 - a^2) / 2, with a the age of its newest frame and D the age of its frame used
    last. If a new frame is always at hand (a = 0), this is the Whittle index of the age of information over a
    reliable channel (Kadota et al., IEEE/ACM ToN 2018, with p = 1 and up to half a slot).
    """

    name = "whittle"

    def _index(self, camera: str, known_ms: float, age_ms: float) -> float:
        return (known_ms**2 - age_ms**2) / 2


class _SeeingPolicy(IndexPolicy):
    """Base of policies whose index needs embeddings (6.31), of any width. A camera without an embedding
    counts as an average one."""

    embedding = None, ""

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        super().__init__(value, rng)
        self._seen: Mapping[str, Embedding] = {}

    def _look(self, epoch: Epoch) -> None:
        state = None if epoch.state is None else epoch.state(("semantics",))
        self._seen = {}
        if state is not None and state.embeddings is not None:
            rows = zip(state.cameras, state.embeddings)
            self._seen = {camera: z for camera, z in rows if np.isfinite(z).all()}


class IncorrectAge(_SeeingPolicy):
    """Age of incorrect information: selects the k views whose change the field has missed for longest.

    A camera's index is D |z - z'|, with D the age of its frame used last, z' the embedding of that frame and
    z the embedding of its newest: the age of incorrect information with linear time and distance as penalty
    (Maatouk et al., IEEE/ACM ToN 2020). The edge cannot see the source itself: the newest frame stands for
    it, and what the field knows was correct when the frame used last was taken.
    """

    name = "aoii"

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        super().__init__(value, rng)
        self._known: dict[str, Embedding] = {}
        self._distance: dict[str, float] = {}
        self._average = 1.0

    def _look(self, epoch: Epoch) -> None:
        super()._look(epoch)
        both = self._seen.keys() & self._known.keys()
        self._distance = {c: float(np.linalg.norm(self._seen[c] - self._known[c])) for c in both}
        self._average = _average(self._distance.values())

    def _index(self, camera: str, known_ms: float, age_ms: float) -> float:
        if known_ms <= age_ms:  # its newest frame was used
            return 0.0
        return known_ms * self._distance.get(camera, self._average)

    def _use(self, cameras: set[str]) -> None:
        for camera in cameras:
            self._known.pop(camera, None)
        self._known |= {c: self._seen[c] for c in cameras if c in self._seen}


class PredictedCovariance(_SeeingPolicy):
    """Largest predicted covariance: selects the k views that most reduce the predicted variance.

    The embedding of a camera's view is modelled as a random walk: its variance grows by q D from the frame
    used last, of age D, until now, and using the newest frame, of age a, leaves q a of that. The index is
    q (D - a), the reduction of the predicted covariance (value of information in Ayan et al., ICCPS 2019).
    q, per camera, is the squared change of embeddings between successive newest frames, over their time.
    """

    name = "covariance"

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        super().__init__(value, rng)
        self._last: dict[str, tuple[int, Embedding]] = {}
        self._walk: dict[str, tuple[float, float]] = {}
        """camera -> sum of squared changes, and of the milliseconds that they took."""
        self._rate: dict[str, float] = {}
        self._average = 1.0

    def _look(self, epoch: Epoch) -> None:
        super()._look(epoch)
        for camera in epoch.generated_ns:
            z, at_ns = self._seen.get(camera), epoch.generated_ns[camera]
            if z is None:
                continue
            before = self._last.setdefault(camera, (at_ns, z))
            if at_ns > before[0]:
                squares, ms = self._walk.get(camera, (0.0, 0.0))
                change = float(((z - before[1]) ** 2).sum())
                self._walk[camera] = squares + change, ms + (at_ns - before[0]) / 1e6
                self._last[camera] = at_ns, z
        self._rate = {c: squares / ms for c, (squares, ms) in self._walk.items()}
        self._average = _average(self._rate.values())

    def _index(self, camera: str, known_ms: float, age_ms: float) -> float:
        return self._rate.get(camera, self._average) * (known_ms - age_ms)


def _average(values: Collection[float]) -> float:
    return sum(sorted(values)) / len(values) if values else 1.0
