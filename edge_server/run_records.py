"""What the files of a run hold: the structs with which the edge, fits and exports write, and the report reads.

series.jsonl has one line an update, a ``live.state.Publication``, of which ``UpdateRow`` is the part that a
report takes. A number that no run can have measured (not finite, or beyond ``Number``) makes its line, or its
file, unreadable.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, Struct, field

Number = Annotated[float, Meta(ge=-1e15, le=1e15)]
Count = Annotated[int, Meta(ge=0, le=10**15)]
Instant = Annotated[int, Meta(ge=0, le=2**62)]  # nanoseconds of some clock


class UpdateRow(Struct, kw_only=True):
    """A line of series.jsonl. selected: the cameras whose views were used, or of a fit their number."""

    t_s: Number
    number: Count | None = None
    selected: list[str] | Count | None = None
    refused: list[str] = field(default_factory=list)
    steps: Count | None = None
    loss: Number | None = None
    update_ms: Number | None = None
    aaoi_ms: Number | None = None
    psnr_db: Number | None = None
    psnr_moving_db: Number | None = None
    ssim: Number | None = None
    lpips: Number | None = None
    psnr_refined_db: Number | None = None
    ssim_refined: Number | None = None
    truth_gap_ms: Number | None = None
    network_ms: Number | None = None
    scored_on: str | None = None


class AgeParts(Struct):
    """What the mean age of the views behind an image that was shown consists of, milliseconds."""

    network: Number | None = None
    waiting: Number | None = None
    computing: Number | None = None
    display: Number | None = None


def age_parts_ms(updates: Sequence[Any], now_s: float) -> dict[str, float]:
    """The parts of the age of what is shown at a random instant, milliseconds, means over some updates: network
    (capture to arrival), waiting (to the decision), computing (to publication), and display (since publication; an
    instant meets long gaps more often). Empty for fewer than two updates, or where no network time is known.

    updates: in order, each with number, t_s, network_ms, update_ms, aaoi_ms (``UpdateRow``, ``Publication``). Where
    numbers are left out, publications lie evenly between; an edge that starts again may repeat some. now_s: on their
    clock; nothing is published since the last.
    """
    known = [each for u in updates if None not in (each := (u.network_ms, u.update_ms, u.aaoi_ms))]
    if len(updates) < 2 or not known:
        return {}
    gap_ms = 1e3 * np.diff([*(u.t_s for u in updates), now_s])
    gaps = np.maximum(np.diff([*(u.number for u in updates), updates[-1].number + 1]), 1)
    network, computing, age = np.mean(known, axis=0)
    parts = {
        "network": network,
        "waiting": age - network - computing,
        "computing": computing,
        "display": np.sum(gap_ms**2 / gaps) / max(2.0 * np.sum(gap_ms), 1e-3),
    }
    return {name: max(float(ms), 0.0) for name, ms in parts.items()}


class SoFarScores(Struct):
    """Scores of a held-out camera that moves (``fidelity.so_far``): of its newest frame (now), and of its frames so far
    from the newest field (all). frames: how many these are. refined: at poses and exposures as the field corrects
    them."""

    now_psnr_db: Number
    all_psnr_db: Number
    now_ssim: Number | None = None
    all_ssim: Number | None = None
    frames: Count = 1
    refined: bool = False

    def words(self) -> str:
        """In one line, for people."""
        poses = ", at refined poses" if self.refined else ""
        return f"now {self.now_psnr_db:.2f} dB, all {self.frames} frames so far {self.all_psnr_db:.2f} dB{poses}"


class ShownRow(Struct, kw_only=True):
    """A line of shown.jsonl: the score of what was shown at ``t_s``, at poses as given. number: the update that was
    extrapolated. so_far: of held-out cameras that move, as known then."""

    t_s: Number
    number: Count | None = None
    psnr_db: Number | None = None
    psnr_moving_db: Number | None = None
    psnr_still_db: Number | None = None
    ssim: Number | None = None
    lpips: Number | None = None
    age_ms: AgeParts = field(default_factory=AgeParts)
    so_far: SoFarScores | None = None


class AgesRow(Struct, omit_defaults=True):
    """A line of ages.jsonl: the age of every camera's newest frame, None before its first; and of the newest depth of
    those that send it."""

    t_s: Number
    age_ms: dict[str, Number | None]
    depth_age_ms: dict[str, Number] = {}


class UpdateCounts(Struct):
    """The edge's own counts of its updates. without_step: updates that had no time for a step of training; None where
    nobody has counted them. refused: by camera, how often the field left its view out."""

    count: Count = 0
    ms_p50: Number | None = None
    ms_p95: Number | None = None
    first_ms: Number | None = None
    undecodable: Count | None = None
    shed: Count | None = None
    without_step: Count | None = None
    refused: dict[str, Count] = field(default_factory=dict)


class Baseline(Struct, frozen=True):
    """PSNR of two baselines that need no field: a flat image in the mean color, and the nearest camera's own image."""

    mean_color_db: Number | None = None
    nearest_view_db: Number | None = None


class DepthCounts(Struct):
    """Depth that arrived with a camera's frames: how many had it, and its encoded bytes."""

    frames: Count
    bytes: Count


class DepthStatus(Struct):
    """Depth that arrived, by camera, and how much of it was damaged."""

    cameras: dict[str, DepthCounts]
    undecodable: Count = 0


class FitData(Struct):
    """The data set of a fit. training: number of views. held_out: names of cameras. missing: entries without
    an image."""

    file: str
    instant: str | None
    training: Count
    held_out: list[str]
    missing: Count


class Event(Struct):
    """Something that happened at ``t_s``, in words."""

    t_s: Number
    what: str


class RunFacts(Struct):
    """Where and how a process ran, as it said itself (``machine.run_facts``). started: date and time, ISO 8601.
    machine, versions: see ``machine``."""

    started: str | None = None
    command: str | None = None
    commit: str | None = None
    host: str | None = None
    machine: dict[str, Any] = {}
    versions: dict[str, str | None] = {}


class EdgeStatus(Struct, kw_only=True):
    """What a report takes from edge.json. seconds: of fitting. started_ns, uptime_s: of a live edge. chosen: how the
    edge works and why, in one line. troubles: what the field finds wrong with frames, poses and depth, a line each.
    last_frames: sequence and capture time of the last frame of each camera's
    sessions."""

    kind: Literal["live", "fit", "simulated"] = "live"
    run: RunFacts = field(default_factory=RunFacts)
    events: list[Event] = []
    scenario: str | None = None
    seed: int | None = None
    field: str | None = None
    chosen: str | None = None
    policy: str | None = None
    value: Number | None = None
    seconds: Number | None = None
    started_ns: Instant | None = None
    uptime_s: Number | None = None
    lines_lost: Count = 0
    troubles: list[str] = []
    updates: UpdateCounts | None = None
    foreground: dict[str, Number | None] | None = None
    baseline: Baseline | None = None
    so_far: SoFarScores | None = None
    depth: DepthStatus | None = None
    data: FitData | None = None
    lpips_missing: str | None = None
    lpips_network: str | None = None
    last_frames: dict[str, dict[str, tuple[int, int]]] = {}


class Histogram(Struct):
    """Edges of the bins (n + 1) and the counts in them (n)."""

    edges_ms: list[Number]
    counts: list[Number]

    def __post_init__(self) -> None:
        if len(self.edges_ms) != len(self.counts) + 1:
            raise ValueError(f"{len(self.edges_ms)} edges do not bound {len(self.counts)} bins")


class Delays(Struct, omit_defaults=True):
    """A distribution of delays, milliseconds."""

    count: Count | None = None
    mean: Number | None = None
    p50: Number | None = None
    p95: Number | None = None
    p99: Number | None = None
    max: Number | None = None
    histogram: Histogram | None = None


class ChannelChange(Struct):
    """A change of the channel by an operator, at an instant of the emulator's clock; without delay (ms) and loss the
    scenario's channel came back."""

    at_ns: Instant
    delay_ms: Number | None = None
    loss: Number | None = None


class ChannelStatus(Struct, omit_defaults=True):
    """What a report takes from the emulator's channel.json. state_share: share of time in each state."""

    preset: str | None = None
    discipline: str | None = None
    changes: list[ChannelChange] = []
    state_share: dict[str, Number] | None = None
    drawn_delay_ms: Delays | None = None
    delay_error_ms: Delays | None = None


class FrontierPoint(Struct, frozen=True):
    """A measured setting of updates, and the fidelity with it.

    speed_m_per_s: speed of what moves in the scene it was measured on.
    update_ms: time from decision to publication; for a field in layers, from one update to the next.
    psnr_db, psnr_moving_db: PSNR of the whole image, and of the pixels where the scene moves.
    error_db: upper bound of the standard error of their mean; 0 with one seed.
    measured: what the PSNR was measured on, what was "shown" or (earlier versions) what was "published".
    """

    update_ms: Number
    psnr_db: Number
    psnr_moving_db: Number
    speed_m_per_s: Number = 1.0
    error_db: Number = 0.0
    measured: str = "shown"

    @property
    def mean_db(self) -> float:
        """Mean of both: the whole image of a mostly static scene alone would hide what age costs."""
        return 0.5 * (self.psnr_db + self.psnr_moving_db)


class Frontier(Struct):
    """frontier.json: what accuracy costs in time, as measured before the run for its field.

    points: those measured at the speed nearest to that of the run's scene.
    about: which file they come from, or why there are none.
    """

    points: list[FrontierPoint]
    about: str
