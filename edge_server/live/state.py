"""The shared state of a running edge server: what people can see and change.

The loop and ingest write it; page, metrics and status service read it. Readers never wait for the field: all they get
is immutable, or was copied under a short lock.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import takewhile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity.scorer import SELECTED, Score
from edge_server.fields import Snapshot
from edge_server.live import live_constants as tuned
from edge_server.run_records import Frontier, SoFarScores
from edge_server.scheduler import Policy
from freshfield.frame import Frame


@dataclass(frozen=True)
class Publication:
    """One update of the field: a line of series.jsonl and of the report's fidelity series.

    number: counts updates from 0; a resumed run continues to count.
    t_s, published_ns: instant of publication (the present), in seconds since the run began and on the edge's
    clock.
    omega_ms: the policy's omega; None for policies without one.
    selected: cameras whose frames were used. ages_ms: their ages at publication. aaoi_ms: mean of these ages
    (6.35).
    update_ms: time from decision to publication.
    network_ms: mean time of the selected frames from capture to arrival; the rest of aaoi_ms, beyond update_ms
    and network_ms, is the time that they waited in the buffer.
    steps, loss: of the fit, see ``fields.FitReport``.
    refused: selected cameras whose view the field left out because it contradicts all others.
    psnr_db to truth_gap_ms: None until the held-out truth nearest to the present has arrived, or if there is
    nothing to score. truth_gap_ms: time from the present to that truth.
    scored_on: held-out camera, or SELECTED where nothing is held out (6.21-6.22).
    psnr_refined_db, ssim_refined: see ``fidelity.scorer.Score``.
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
    psnr_db: float | None = None
    psnr_moving_db: float | None = None
    ssim: float | None = None
    lpips: float | None = None
    truth_gap_ms: float | None = None
    scored_on: str | None = None
    network_ms: float | None = None
    psnr_refined_db: float | None = None
    ssim_refined: float | None = None

    @property
    def views(self) -> float:
        """Number of cameras whose frames the update used."""
        return float(len(self.selected))

    def scored(self, score: Score) -> Publication:
        """This publication with its fidelity."""
        return replace(
            self,
            psnr_db=score.psnr_db,
            psnr_moving_db=score.psnr_moving_db,
            ssim=score.ssim,
            lpips=score.lpips,
            truth_gap_ms=score.truth_gap_ms,
            scored_on=score.camera if score.on == "held-out" else SELECTED,
            psnr_refined_db=score.psnr_refined_db,
            ssim_refined=score.ssim_refined,
        )


@dataclass(frozen=True)
class CameraView:
    """What readers see of a camera: its newest frame (still encoded), its age, its counts.

    measures_depth: whether any frame of it had depth.
    """

    camera: str
    held_out: bool
    newest: Frame | None
    age_ms: float | None
    delivered: int
    rejected: int
    measures_depth: bool = False


@dataclass(frozen=True)
class Comparison:
    """A held-out truth and its rendering, both uint8 RGB (H, W, 3). number: that of the publication."""

    camera: str
    truth: NDArray[np.uint8]
    rendered: NDArray[np.uint8]
    number: int


@dataclass
class Controls:
    """What an operator may change during a run; the update loop follows. policy, value: name and value of the current
    policy. chosen: the policy to change to; None: none was chosen."""

    policy: str
    value: float | None
    paused: bool = False
    reset_requested: bool = False
    chosen: Policy | None = None


@dataclass
class EdgeState:
    """The state of one run. Methods are thread-safe; the server sets the callbacks once.

    start_ns, now_ns: the instant at which the run began, and the present, on the clock of frames.
    channel: the emulator's status (channel.json) if it runs on the same machine, else None.
    frontier: the measured trade-off of accuracy against time.
    chosen: how the edge works and why, in one line (``config.described``).
    troubles: problems that the field finds in poses and measured depth, in words.
    flat_db: PSNR of the mean color of the training images against the scored views: the held-out ones, or if
    nothing is held out the views learned from; None: not known.
    so_far: scores of moving held-out cameras.
    warnings: security risks of this run's options (--insecure), in words.
    events: (seconds since the run began, what happened), for the report; ``note`` adds one. Those of an earlier process
        have negative seconds: before it ended.
    status_line: what the loop is doing, in one line for people, e.g. waiting for a first frame.
    renderer, comparison: the newest ones; None before the first.
    """

    scenario: str
    policies: tuple[str, ...]
    controls: Controls
    cameras: Callable[[], list[CameraView]]
    start_ns: int
    now_ns: Callable[[], int]
    set_policy: Callable[[str, float | None], None]
    save_snapshot: Callable[[], Path]
    channel: Callable[[], dict | None] = lambda: None
    troubles: Callable[[], Sequence[str]] = tuple
    flat_db: Callable[[], float | None] = lambda: None
    so_far: Callable[[], SoFarScores | None] = lambda: None
    frontier: Frontier | None = None
    field_name: str = ""
    chosen: str = ""
    started: bool = False
    status_line: str = ""
    warnings: list[str] = field(default_factory=list)
    events: deque[tuple[float, str]] = field(default_factory=lambda: deque(maxlen=tuned.MOST_EVENTS))
    _publications: deque[Publication] = field(default_factory=lambda: deque(maxlen=tuned.KEPT_PUBLICATIONS))
    _shown: deque[Score] = field(default_factory=lambda: deque(maxlen=tuned.SHOWN_OF))
    renderer: Snapshot | None = None
    comparison: Comparison | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def now_s(self) -> float:
        """Seconds since the run began."""
        return (self.now_ns() - self.start_ns) / 1e9

    def note(self, what: str) -> None:
        """Remember an event, in words: it is marked on the report's curves."""
        self.events.append((round(self.now_s(), 3), what))

    def publish(self, publication: Publication, renderer: Snapshot) -> None:
        """Add a publication."""
        with self._lock:
            self._publications.append(publication)
            self.renderer = renderer
            self.started = True

    def scored(self, publication: Publication, comparison: Comparison | None) -> None:
        """Replace the publication of the same number by this scored one."""
        with self._lock:
            for i in range(len(self._publications) - 1, -1, -1):
                if self._publications[i].number == publication.number:
                    self._publications[i] = publication
                    break
            if comparison is not None:
                self.comparison = comparison

    def add_shown(self, score: Score) -> None:
        """Add a score of what was shown at a random instant."""
        with self._lock:
            self._shown.append(score)

    def present(self) -> tuple[float, float, float | None] | None:
        """The run's own point on the frontier, averaged over the latest scored instants and updates:
        milliseconds from one update to the next, PSNR shown of the whole image and, where known, of moving
        pixels. None until there are a score and two updates."""
        with self._lock:
            scores, last = list(self._shown), list(self._publications)[-tuned.SHOWN_OF :]
        moving = [s.psnr_moving_db for s in scores if s.psnr_moving_db is not None]
        if not scores or len(last) < 2:
            return None
        whole_db = float(np.mean([s.psnr_db for s in scores]))
        update_ms = 1e3 * (last[-1].t_s - last[0].t_s) / (len(last) - 1)
        return update_ms, whole_db, float(np.mean(moving)) if moving else None

    def publications(self, since: int = -1) -> list[Publication]:
        """Publications with a number above ``since``, oldest first."""
        with self._lock:
            new = takewhile(lambda p: p.number > since, reversed(self._publications))
            return list(new)[::-1]

    def newest(self, scored: bool = False) -> Publication | None:
        """The newest publication, or the newest one that has scores; None before the first."""
        with self._lock:
            every = reversed(self._publications)
            return next((p for p in every if not scored or p.psnr_db is not None), None)
