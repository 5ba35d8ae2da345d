"""What a running edge server shows to people and lets them change.

One object between the loop and ingest, which write, and page, metrics, status service and report, which
read. Readers never wait for the field: everything handed out is immutable or copied under a short lock.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity.scorer import Score
from edge_server.fields import Renderer
from freshfield.frame import Frame

if TYPE_CHECKING:  # loaded only where a policy was learnt
    from edge_server.scheduler.learned.bandit import Decision


@dataclass(frozen=True)
class Publication:
    """One update of the field: a line of series.jsonl and of the report's fidelity series.

    t_s: seconds since the run began, at the instant of publication (the present). aaoi_ms: mean age of the
    selected views then (6.35). Scores are None until the held-out truth nearest to the present arrives,
    or where there is nothing to score; truth_gap_ms: distance in time of that truth from the present.
    """

    number: int
    t_s: float
    published_ns: int
    omega_ms: float | None
    selected: tuple[str, ...]
    ages_ms: tuple[float, ...]
    aaoi_ms: float
    update_ms: float
    steps: int = 0
    loss: float | None = None
    refused: tuple[str, ...] = ()
    """Of the selected cameras, those whose picture the field left out, because it contradicts all others."""
    psnr_db: float | None = None
    psnr_moving_db: float | None = None
    ssim: float | None = None
    lpips: float | None = None
    truth_gap_ms: float | None = None
    scored_on: str | None = None
    """Held-out camera id, or "selected" where nothing is held out (6.21-6.22)."""
    perceptual: float | None = None
    """The stand-in for LPIPS, where the scenario lists it (edge.metrics)."""

    @property
    def views(self) -> float:
        """Number of cameras whose frames the update used."""
        return float(len(self.selected))

    def scored(self, score: Score) -> Publication:
        """The same publication with its fidelity."""
        return replace(
            self,
            psnr_db=score.psnr_db,
            psnr_moving_db=score.psnr_moving_db,
            ssim=score.ssim,
            lpips=score.lpips,
            perceptual=score.perceptual,
            truth_gap_ms=score.truth_gap_ms,
            scored_on=score.camera if score.on == "held-out" else "selected",
        )


@dataclass(frozen=True)
class CameraView:
    """A camera as a reader sees it: its newest frame (still encoded), its age, its counts."""

    camera: str
    held_out: bool
    newest: Frame | None
    age_ms: float | None
    delivered: int
    rejected: int


@dataclass(frozen=True)
class Comparison:
    """Held-out truth beside the rendering, both uint8 RGB (H, W, 3)."""

    camera: str
    truth: NDArray[np.uint8]
    rendered: NDArray[np.uint8]
    number: int


@dataclass
class Controls:
    """What an operator may change while it runs. The loop reads it at each decision epoch."""

    policy: str
    value: float | None
    paused: bool = False
    reset_requested: bool = False


@dataclass
class EdgeState:
    """Shared state of one run. Methods are thread-safe; callbacks are set once by the server."""

    scenario: str
    policies: tuple[str, ...]
    controls: Controls
    cameras: Callable[[], list[CameraView]]
    now_s: Callable[[], float]
    set_policy: Callable[[str, float | None], None]
    save_snapshot: Callable[[], Path]
    channel: Callable[[], dict | None] = lambda: None
    """The emulator's status (channel.json) where it runs on the same machine, else None."""
    decision: Callable[[], Decision | None] = lambda: None
    """The newest decision of a policy that was learnt, with what it saw; None of any other policy."""
    embed: Callable[[Sequence[NDArray[np.uint8]]], NDArray[np.float32]] | None = None
    """Embeds pictures as that policy does, on any thread; None where nothing is embedded."""
    field_name: str = ""
    learning: Callable[[], str] = lambda: ""
    """One line on a policy that learns while it is used; empty where none does."""
    started: bool = False
    bounds: NDArray[np.float64] | None = None
    """World box (2, 3) in metres of what the field represents, once known."""
    last_decision: str = ""
    """One line for people: what the loop is doing, e.g. waiting for a first frame."""
    _publications: deque[Publication] = field(default_factory=lambda: deque(maxlen=4096))
    _renderer: Renderer | None = None
    _comparison: Comparison | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _changed: threading.Condition = field(default_factory=threading.Condition)

    def publish(self, publication: Publication, renderer: Renderer) -> None:
        """The field was updated; wakes everybody who waits."""
        with self._lock:
            self._publications.append(publication)
            self._renderer = renderer
            self.started = True
        with self._changed:
            self._changed.notify_all()

    def scored(self, publication: Publication, comparison: Comparison | None) -> None:
        """A publication has got its scores: replaces the unscored record of the same number."""
        with self._lock:
            for i in range(len(self._publications) - 1, -1, -1):
                if self._publications[i].number == publication.number:
                    self._publications[i] = publication
                    break
            if comparison is not None:
                self._comparison = comparison
        with self._changed:
            self._changed.notify_all()

    def publications(self, since: int = -1) -> list[Publication]:
        """Publications with a number above ``since``, oldest first."""
        with self._lock:
            return [p for p in self._publications if p.number > since]

    @property
    def renderer(self) -> Renderer | None:
        with self._lock:
            return self._renderer

    @property
    def comparison(self) -> Comparison | None:
        with self._lock:
            return self._comparison

    def wait_for_change(self, timeout_s: float) -> None:
        with self._changed:
            self._changed.wait(timeout_s)
