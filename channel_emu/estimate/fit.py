"""Fits a channel to a recording: ``channel-emu fit``.

The Bayesian information criterion BIC = k log n - 2 log L (Schwarz, Annals of Statistics 6(2), 1978) chooses
between one state (exponential delays, periodic or Poisson arrivals) and two (``hmm``). Intervals are 95 %:
for the chain, delays and rates from the observed information of the parameters' logarithms; for shares and
run lengths from the means of twenty batches of equal length (Schmeiser, Operations Research 30(3), 1982),
because losses in bursts are not independent.
"""

from __future__ import annotations

import importlib.util
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from channel_emu.estimate import hmm
from channel_emu.estimate.hmm import Z_95, Estimate, Timeline
from channel_emu.estimate.recording import MAX_DELAY_MS, Camera, Recording, RecordingError, read_recording, timelines
from channel_emu.model.config import channel_from_mapping
from channel_emu.model.link import EventKind
from freshfield.scenario import ScenarioError

MIN_DELAYS = 20
# A state with fewer frames or fewer visits counts as outliers.
_MIN_FRAMES, _MIN_VISITS = 10.0, 3.0
# Exponential gaps are within a quarter of their median with probability .17, a periodic camera's nearly
# always.
_NEAR_MEDIAN, _PERIODIC_SHARE = 0.25, 0.5
_CONSTANT_CV = 0.01
# Kolmogorov-Smirnov distance times sqrt(n), for parameters fitted to the same data: above the 1 % level of
# Lilliefors' test for the exponential (1.25), with a margin for two states and dependent delays.
_MISFIT = 1.6
_BATCHES, _T_95 = 20, 2.093
_LOST = (str(EventKind.LOST), str(EventKind.BROKEN))
_DROPPED = (str(EventKind.DROPPED_BUSY), str(EventKind.SUPERSEDED))

Interval = tuple[float, float] | None


@dataclass(frozen=True)
class IntervalEstimate:
    """An estimate with its 95 % interval; ``interval`` is None if the recording does not determine one."""

    value: float
    interval: Interval

    def as_dict(self) -> dict[str, float | None]:
        low, high = self.interval or (None, None)
        return {"value": self.value, "low": low, "high": high}


@dataclass(frozen=True)
class Fit:
    """A fitted channel.

    states: number of states of the chain, 1 or 2. chosen_by: "BIC" or "asked".
    arrivals: periodic, poisson or as-offered.
    parameters: by name, in 1/ms and ms.
    bic: by number of states.
    bursts: statistics of undelivered frames, by name.
    channel: the ``channel:`` section for a scenario.
    estimate: the two-state fit if it was chosen. lines: the observations, one timeline a chain.
    """

    recording: Recording
    states: int
    chosen_by: str
    arrivals: str
    parameters: dict[str, IntervalEstimate]
    bic: dict[int, float]
    bursts: dict[str, IntervalEstimate]
    channel: dict[str, Any]
    warnings: list[str] = field(default_factory=list)
    estimate: Estimate | None = None
    lines: list[Timeline] = field(default_factory=list)

    def summary(self) -> dict[str, Any]:
        """The fit as plain values, as the command prints it with --json."""
        cameras = self.recording.cameras
        span_ms = max(c.offered_ms[-1] for c in cameras) - min(c.offered_ms[0] for c in cameras)
        return {
            "file": str(self.recording.path),
            "frames": self.recording.frames,
            "delays": len(self.recording.delays_ms()),
            "cameras": len(cameras),
            "seconds": round(float(span_ms) / 1e3, 3),
            "states": self.states,
            "chosen_by": self.chosen_by,
            "bic": {str(k): round(v, 3) for k, v in self.bic.items()},
            "arrivals": self.arrivals,
            "parameters": {name: value.as_dict() for name, value in self.parameters.items()},
            "bursts": {name: value.as_dict() for name, value in self.bursts.items()},
            "intervals": "95 %: parameters by observed information, bursts by batch means",
            "warnings": self.warnings,
            "channel": self.channel,
        }


def fit(path: Path, states: str = "auto", *, discipline: str | None = None, scope: str = "shared") -> Fit:
    """Fit a channel to the recording in ``path`` (``recording`` describes the format).

    states: number of states: "1", "2" or "auto" (BIC decides).
    discipline: queue discipline of the recorded link, for rows only; None: drop-new.
    scope: one chain for all cameras (shared), or one each with equal parameters (per-camera).
    Raises RecordingError or TraceError (both ValueError) if the recording cannot be read or fitted.
    """
    if states not in ("1", "2", "auto"):
        raise RecordingError(f"--states {states}: expected 1, 2 or auto")
    recording = read_recording(path, discipline)
    delays_ms = _usable_delays_ms(recording)
    kind, period_ms = _arrivals(recording)
    constant = float(delays_ms.std()) <= _CONSTANT_CV * float(delays_ms.mean())
    poisson = kind == "poisson"
    lines = timelines(recording, scope == "shared", poisson)
    one_state, bic_1 = _fit_one_state(lines, delays_ms, constant, poisson)
    bic = {1: bic_1}
    warnings = _data_warnings(recording, constant, poisson, states)
    estimate = None
    if states != "1" and (poisson or not constant):
        _require_libraries(path)
        estimate = hmm.fit(lines, not constant, poisson)
        if states == "2" and not estimate.finite:
            raise RecordingError(f"{path}: --states 2: delays and arrivals do not determine two states")
    if estimate is not None and not estimate.finite:
        estimate = None
    elif estimate is not None:
        parameter_count = len(estimate.model.log_parameters())
        bic[2] = parameter_count * math.log(_observation_count(lines)) - 2 * estimate.log_likelihood
        why_not = _reject_two_states(estimate, lines)
        if states == "auto" and (why_not or bic[2] >= bic[1]):
            if bic[2] < bic[1]:
                warnings.append(f"two states were preferred by BIC and set aside: {why_not}")
            estimate = None
        elif why_not:
            warnings.append(f"two states as asked, though {why_not}")
    parameters = one_state if estimate is None else _two_state_parameters(estimate, delays_ms, constant)
    if any(value.interval is None for value in parameters.values()):
        warnings.append("the recording does not determine the parameters that stand without an interval")
    if not constant:
        warnings += _misfit_warnings(delays_ms, parameters, estimate, lines)
    chosen_by = "BIC" if states == "auto" else "asked"
    bursts = _loss_statistics(recording.cameras)
    channel = _channel_section(recording, parameters, kind, period_ms, scope, bursts)
    try:
        channel_from_mapping(channel, "the fitted channel")
    except ScenarioError as error:
        raise RecordingError(
            f"{path}: delays and arrivals do not determine a channel of two states ({error}): --states 1"
        ) from None
    return Fit(
        recording,
        1 if estimate is None else 2,
        chosen_by,
        kind,
        parameters,
        bic,
        bursts,
        channel,
        warnings,
        estimate,
        lines,
    )


def _usable_delays_ms(recording: Recording) -> NDArray[np.float64]:
    delays_ms = recording.delays_ms()
    came = sum(int(camera.delivered().sum()) for camera in recording.cameras)
    if not len(delays_ms):
        raise RecordingError(
            f"{recording.path}: none of its {recording.frames} frames came through in less than "
            f"{MAX_DELAY_MS:g} ms: there is no delay to fit"
        )
    if len(delays_ms) < MIN_DELAYS:
        raise RecordingError(
            f"{recording.path}: {len(delays_ms)} delays ({recording.frames} frames, {came} came); at least "
            f"{MIN_DELAYS} are needed, and hundreds for two states: record longer"
        )
    return delays_ms


def _require_libraries(path: Path) -> None:
    if any(importlib.util.find_spec(name) is None for name in ("numba", "scipy")):
        raise RecordingError(
            f"{path}: two states are fitted with numba and scipy (pip install 'freshfield[emu]'); --states 1 "
            "needs neither"
        )


def _arrivals(recording: Recording) -> tuple[str, float]:
    """The arrival process, and the median gap between offers in ms."""
    gaps = np.concatenate([np.diff(camera.offered_ms) for camera in recording.cameras])
    if not len(gaps):
        return "as-offered", 0.0
    median = float(np.median(gaps))
    if recording.sampled:
        return "poisson", median
    near = np.abs(gaps - median) <= _NEAR_MEDIAN * median
    return ("periodic" if near.mean() > _PERIODIC_SHARE else "poisson"), median


def _fit_one_state(
    lines: list[Timeline], delays_ms: NDArray[np.float64], constant: bool, poisson: bool
) -> tuple[dict[str, IntervalEstimate], float]:
    mean, n = float(delays_ms.mean()), len(delays_ms)
    found, log_likelihood = {"mean_ms": IntervalEstimate(mean, (mean, mean))}, 0.0
    if not constant:
        reach = math.exp(Z_95 / math.sqrt(n))
        found["mean_ms"] = IntervalEstimate(mean, (mean / reach, mean * reach))
        log_likelihood -= n * (math.log(mean) + 1)
    if poisson:
        arrivals = sum(int(line.arrived.sum()) for line in lines)
        rate = arrivals / sum(float(line.span_ms @ line.waiting) for line in lines)
        reach = math.exp(Z_95 / math.sqrt(arrivals))
        found["rate_per_ms"] = IntervalEstimate(rate, (rate / reach, rate * reach))
        log_likelihood += arrivals * (math.log(rate) - 1)
    return found, ((not constant) + poisson) * math.log(_observation_count(lines)) - 2 * log_likelihood


def _two_state_parameters(
    estimate: Estimate, delays_ms: NDArray[np.float64], constant: bool
) -> dict[str, IntervalEstimate]:
    names = ["mu1_per_ms", "mu2_per_ms"]
    names += [] if estimate.model.mean_ms is None else ["mean_1_ms", "mean_2_ms"]
    names += [] if estimate.model.rate_per_ms is None else ["rate_1_per_ms", "rate_2_per_ms"]
    values = np.exp(estimate.model.log_parameters())
    found = {name: IntervalEstimate(float(values[i]), estimate.interval(i)) for i, name in enumerate(names)}
    if constant:
        found["mean_ms"] = IntervalEstimate(mean := float(delays_ms.mean()), (mean, mean))
    return found


def _observation_count(lines: list[Timeline]) -> int:
    """Number of delays and arrivals."""
    return sum(int((~np.isnan(line.delay_ms)).sum() + line.arrived.sum()) for line in lines)


def _reject_two_states(estimate: Estimate, lines: list[Timeline]) -> str | None:
    """The reason to reject two states whatever their likelihood, or None."""
    frames = np.zeros(2)
    time_ms = np.zeros(2)
    for line, states in zip(lines, estimate.states):
        frames += states[~np.isnan(line.delay_ms) | line.arrived].sum(0)
        time_ms += line.span_ms @ states
    if frames.min() < _MIN_FRAMES:
        return f"one of them rests on {frames.min():.0f} frames"
    jumps = estimate.model.leave_per_ms * time_ms
    if jumps.min() < _MIN_VISITS:
        return f"the chain changed state {jumps.sum():.0f} times only: record longer"
    return None


def _data_warnings(recording: Recording, constant: bool, poisson: bool, states: str) -> list[str]:
    notes = []
    if recording.too_long:
        notes.append(f"{recording.too_long} frames took longer than {MAX_DELAY_MS:g} ms: left out")
    if constant:
        what = "states are told apart by arrivals alone" if poisson else "there is nothing to tell states by"
        notes.append(f"the delays hardly vary: {what}")
        if states == "2" and not poisson:
            raise RecordingError(
                f"{recording.path}: --states 2: the delays hardly vary and the arrivals are "
                "periodic: there is nothing to tell states by"
            )
    return notes


def _misfit_warnings(
    delays_ms: NDArray[np.float64],
    parameters: dict[str, IntervalEstimate],
    estimate: Estimate | None,
    lines: list[Timeline],
) -> list[str]:
    """A warning if the delays do not follow the fitted law (Kolmogorov-Smirnov distance)."""
    if estimate is None or estimate.model.mean_ms is None:
        means, shares = np.array([parameters["mean_ms"].value]), np.ones(1)
    else:
        has_delay = [~np.isnan(line.delay_ms) for line in lines]
        weight = sum(s[t].sum(0) for s, t in zip(estimate.states, has_delay))
        means, shares = estimate.model.mean_ms, weight / np.sum(weight)
    ordered = np.sort(delays_ms)
    below = (shares * -np.expm1(-ordered[:, None] / means)).sum(1)
    n = len(ordered)
    distance = max((np.arange(1, n + 1) / n - below).max(), (below - np.arange(n) / n).max())
    if distance * math.sqrt(n) <= _MISFIT:
        return []
    return [
        f"the delays are not exponential by state (their distribution differs by {distance:.3f}): the means "
        "hold, shapes do not; --service trace:FILE of simulate replays the delays themselves"
    ]


def _loss_statistics(cameras: list[Camera]) -> dict[str, IntervalEstimate]:
    """Shares of dropped and lost frames, lengths of runs of undelivered and of delivered frames, gaps between
    deliveries. Skipped frames and those still inside the link are not counted."""
    found: dict[str, IntervalEstimate] = {}
    kept = [camera.outcome[(camera.outcome != EventKind.SKIPPED) & (camera.outcome != "")] for camera in cameras]
    gone = [np.isin(outcome, _DROPPED + _LOST) for outcome in kept]
    found["dropped_share"] = _batch_share([np.isin(o, _DROPPED) for o in kept], [np.ones(len(o), bool) for o in kept])
    found["lost_share"] = _batch_share([np.isin(o, _LOST) for o in kept], [~np.isin(o, _DROPPED) for o in kept])
    for name, values in (("run_of_missing", gone), ("run_of_delivered", [~g for g in gone])):
        runs = np.concatenate([_runs(value) for value in values])
        if len(runs):
            found[f"{name}_frames"] = _batch_mean(runs)
            found[f"longest_{name}_frames"] = IntervalEstimate(float(runs.max()), None)
    gaps = [np.diff(np.sort((c.started_ms + c.delay_ms)[c.delivered() & ~np.isnan(c.delay_ms)])) for c in cameras]
    together = np.concatenate(gaps)
    if len(together):
        found["gap_ms"] = _batch_mean(together)
        found["longest_gap_ms"] = IntervalEstimate(float(together.max()), None)
    return found


def _runs(flags: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Lengths of the runs of True."""
    edges = np.diff(np.concatenate([[0], flags.astype(np.int64), [0]]))
    return np.flatnonzero(edges == -1) - np.flatnonzero(edges == 1)


def _batch_share(counted: list[NDArray[np.bool_]], among: list[NDArray[np.bool_]]) -> IntervalEstimate:
    """Number of ``counted`` over the number of ``among``, with an interval by batch means."""
    top, bottom = np.zeros(_BATCHES), np.zeros(_BATCHES)
    for some, every in zip(counted, among):
        stretch = np.arange(len(some)) * _BATCHES // max(len(some), 1)
        top += np.bincount(stretch, some, _BATCHES)
        bottom += np.bincount(stretch, every, _BATCHES)
    total = float(bottom.sum())
    if not total:
        return IntervalEstimate(0.0, None)
    share = float(top.sum()) / total
    if not 0 < share < 1:
        # None or all of n were counted: the exact 95 % bound.
        bound = 1 - 0.05 ** (1 / total)
        return IntervalEstimate(share, (0.0, bound) if share == 0 else (1 - bound, 1.0))
    # Ratio estimator; its variance comes from the batches' residuals.
    reach = _T_95 * float(np.sqrt(((top - share * bottom) ** 2).sum() * _BATCHES / (_BATCHES - 1))) / total
    return IntervalEstimate(share, (max(share - reach, 0.0), min(share + reach, 1.0)))


def _batch_mean(values: NDArray[Any]) -> IntervalEstimate:
    """Mean of a series with an interval by batch means."""
    mean = float(values.mean())
    if len(values) < 2 * _BATCHES:
        return IntervalEstimate(mean, None)
    means = np.array([batch.mean() for batch in np.array_split(values.astype(float), _BATCHES)])
    reach = _T_95 * float(means.std(ddof=1)) / math.sqrt(_BATCHES)
    return IntervalEstimate(mean, (mean - reach, mean + reach))


def _channel_section(
    recording: Recording,
    parameters: dict[str, IntervalEstimate],
    arrivals: str,
    period_ms: float,
    scope: str,
    bursts: dict[str, IntervalEstimate],
) -> dict[str, Any]:
    """The ``channel:`` section, rounded to six digits."""

    def number(name: str) -> float:
        return float(f"{parameters[name].value:.6g}")

    def by_state(one: str, two: str) -> float | list[float]:
        return number(one) if one in parameters else [number(two.format(1)), number(two.format(2))]

    section: dict[str, Any] = {"arrivals": {"process": arrivals}}
    if arrivals == "periodic":
        section["arrivals"]["period_ms"] = float(f"{max(period_ms, 1e-3):.6g}")
    elif arrivals == "poisson":
        section["arrivals"]["rate_per_ms"] = by_state("rate_per_ms", "rate_{}_per_ms")
    if "mu1_per_ms" in parameters:
        rates = {name: number(name) for name in ("mu1_per_ms", "mu2_per_ms")}
        section["chain"] = {**rates, "states": ["low", "high"], "scope": scope}
    mean = by_state("mean_ms", "mean_{}_ms")
    if mean == 0.0:
        section["service"] = {"law": "none"}
    else:
        exact = parameters.get("mean_ms")
        law = "deterministic" if exact and exact.interval == (exact.value, exact.value) else "exponential"
        section["service"] = {"law": law, "mean_ms": mean}
    section["discipline"] = recording.discipline
    if bursts["lost_share"].value > 0:
        section["faults"] = {"loss": {"probability": float(f"{bursts['lost_share'].value:.6g}")}}
    return section
