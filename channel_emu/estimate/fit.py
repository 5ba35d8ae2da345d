"""Fits a channel to a recording: ``channel-emu fit``.

The Bayesian information criterion BIC = k log n - 2 log L (Schwarz, Annals of Statistics 6(2), 1978) chooses between
one state and two (``two_states``), and between exponential and gamma delays. Intervals are 95 %, by parametric
bootstrap: the fitted channel draws recordings with frames at the same instants, which are fitted as the recording was.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from channel_emu.estimate import estimate_constants as tuned
from channel_emu.estimate import two_states
from channel_emu.estimate.recording import (
    MAX_DELAY_MS,
    Recording,
    RecordingError,
    Transmissions,
    read_recording,
    transmissions,
)
from channel_emu.estimate.two_states import Segments, TwoStates
from channel_emu.model.settings import channel_from_mapping
from freshfield.scenario import ScenarioError

_Z_95 = 1.959964

Interval = tuple[float, float] | None


@dataclass(frozen=True)
class IntervalEstimate:
    """An estimate with its 95 % interval; ``interval`` is None if the recording does not determine one."""

    value: float
    interval: Interval = None

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
    channel: the ``channel:`` section for a scenario.
    sent: the transmissions. second_state: probability of the second state at each; None of a channel with one.
    """

    recording: Recording
    states: int
    chosen_by: str
    arrivals: str
    parameters: dict[str, IntervalEstimate]
    bic: dict[int, float]
    channel: dict[str, Any]
    warnings: list[str]
    sent: Transmissions
    second_state: NDArray[np.float64] | None

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
            "intervals": "95 %, by parametric bootstrap",
            "warnings": self.warnings,
            "channel": self.channel,
        }


@dataclass(frozen=True)
class _Candidate:
    """One of the models that BIC chooses from. law: of the delays, see ``two_states.step``. model: of one state, two
    that are alike."""

    states: int
    law: str
    bic: float
    model: TwoStates


def fit(
    path: Path, states: str = "auto", *, discipline: str | None = None, samples: int = tuned.BOOTSTRAP_SAMPLES
) -> Fit:
    """Fit a channel to the recording in ``path`` (``recording`` describes the format).

    states: number of states: "1", "2" or "auto" (BIC decides).
    discipline: queue discipline of the recorded link, for rows only; None: drop-new.
    samples: number of bootstrap samples.
    Raises RecordingError or TraceError (both ValueError) if the recording cannot be read or fitted.
    """
    if states not in ("1", "2", "auto"):
        raise RecordingError(f"--states {states}: expected 1, 2 or auto")
    recording = read_recording(path, discipline)
    if recording.apart and states != "1":
        raise RecordingError(
            f"{path}: each camera has a chain of its own (scope per-camera), and in a fit they share one: --states 1, "
            "or a file of the first line and those of one camera"
        )
    delays_ms = _usable_delays_ms(recording)
    constant = float(delays_ms.std()) <= tuned.CONSTANT_CV * float(delays_ms.mean())
    sent = transmissions(recording)
    _, delay_ms, lost = sent
    loses = bool((lost == 1.0).any())
    warnings = _data_warnings(recording, constant, loses, states)
    data = two_states.segments(sent, bool(np.isnan(delay_ms[lost == 1.0]).all()))
    laws = ("constant",) if constant else ("exponential", "gamma")
    best = {1: min((_one_state(data, delays_ms, lost, law) for law in laws), key=lambda each: each.bic)}
    if states != "1" and (loses or not constant):
        best[2] = min((_two_states(data, delays_ms, lost, law) for law in laws), key=lambda each: each.bic)
    chosen = best[1]
    if 2 in best:
        why_not = _reject_two_states(best[2], data, sent)
        if states == "2" or (not why_not and best[2].bic < best[1].bic):
            chosen = best[2]
            warnings += [f"two states as asked, though {why_not}"] if why_not else []
        elif best[2].bic < best[1].bic:
            warnings.append(f"two states were preferred by BIC and set aside: {why_not}")
    parameters, drawn_ms = _with_intervals(chosen, data, delays_ms, lost, samples)
    if any(value.interval is None for value in parameters.values()):
        warnings.append("the recording does not determine the parameters that stand without an interval")
    if len(drawn_ms):
        warnings += _misfit_warnings(delays_ms, drawn_ms)
    kind, period_ms = _arrivals(recording)
    if kind == "poisson":
        parameters["rate_per_ms"] = _arrival_rate(recording)
    channel = _channel_section(recording, parameters, chosen.law, kind, period_ms)
    try:
        channel_from_mapping(channel, "the fitted channel")
    except ScenarioError as error:
        raise RecordingError(
            f"{path}: delays and losses do not determine a channel of two states ({error}): --states 1"
        ) from None
    return Fit(
        recording,
        chosen.states,
        "BIC" if states == "auto" else "asked",
        kind,
        parameters,
        {k: each.bic for k, each in best.items()},
        channel,
        warnings,
        sent,
        _second_state(chosen, data, len(lost)) if chosen.states == 2 else None,
    )


def _usable_delays_ms(recording: Recording) -> NDArray[np.float64]:
    delays_ms = recording.delays_ms()
    if len(delays_ms) < tuned.MIN_DELAYS:
        came = sum(int(camera.delivered().sum()) for camera in recording.cameras)
        raise RecordingError(
            f"{recording.path}: {len(delays_ms)} delays below {MAX_DELAY_MS:g} ms ({recording.frames} frames, {came} "
            f"came); at least {tuned.MIN_DELAYS} are needed, and hundreds for two states: record longer"
        )
    return delays_ms


def _data_warnings(recording: Recording, constant: bool, loses: bool, states: str) -> list[str]:
    notes = []
    waits = recording.discipline in ("fcfs", "parallel")
    if recording.inferred and loses and not waits:
        also, wrong = ("", "too high") if recording.discipline == "drop-new" else (" and waiting ones do not", "wrong")
        notes.append(
            f"frames dropped while a lost one was in transmission count as lost too{also}, so losses come out {wrong} "
            "where delays exceed the frame period: a column outcome (delivered, lost, dropped_busy) tells them apart"
        )
    if constant:
        what = "states are told apart by losses alone" if loses else "there is nothing to tell states by"
        notes.append(f"the delays hardly vary: {what}")
        if states == "2" and not loses:
            raise RecordingError(
                f"{recording.path}: --states 2: the delays hardly vary and no frame was lost: there is nothing to "
                "tell states by"
            )
    return notes


def _one_state(data: Segments, delays_ms: NDArray[np.float64], lost: NDArray[np.float64], law: str) -> _Candidate:
    mean_ms, loss, shape = _one_state_parameters(delays_ms, lost, law)
    model = TwoStates(np.ones((1, 2)), np.full((1, 2), mean_ms), np.full((1, 2), loss), np.array([shape]))
    free = (law != "constant") + (law == "gamma") + bool(loss)
    log_likelihood = float(two_states.step(model, data, law)[1][0])
    return _Candidate(1, law, free * math.log(len(lost)) - 2 * log_likelihood, model)


def _one_state_parameters(
    delays_ms: NDArray[np.float64], lost: NDArray[np.float64], law: str
) -> tuple[float, float, float]:
    """Mean delay (at least two_states.MIN_DELAY_MS, unless it is constant), loss and shape."""
    known, positive_ms = lost[~np.isnan(lost)], np.maximum(delays_ms, two_states.MIN_DELAY_MS)
    mean_ms = float((delays_ms if law == "constant" else positive_ms).mean())
    spread = math.log(float(positive_ms.mean())) - float(np.log(positive_ms).mean())
    shape = float(two_states.gamma_shape(np.array(spread))) if law == "gamma" else 1.0
    return mean_ms, float(known.mean()) if len(known) else 0.0, shape


def _two_states(data: Segments, delays_ms: NDArray[np.float64], lost: NDArray[np.float64], law: str) -> _Candidate:
    """The most likely model of two states: a few steps from several models on the first part of the data, then from
    the best of them to the maximum."""
    mean_ms, loss, shape = _one_state_parameters(delays_ms, lost, law)
    head = data.head(tuned.START_SEGMENTS)
    frames = max(int((~np.isnan(data.lost) | ~np.isnan(data.delay_ms)).sum()), 1)
    between_ms = max(float(data.span_ms.sum()) / frames, 1e-9)
    one = tuned.START_CONTRAST
    contrasts = [one, one[::-1]] if loss and law != "constant" else [one]
    starts = [(n, contrast) for n in tuned.START_FRAMES for contrast in contrasts]
    begin = TwoStates(
        np.array([[1 / (n * between_ms)] * 2 for n, _ in starts]),
        max(mean_ms, two_states.MIN_DELAY_MS) * np.array([one] * len(starts)),
        np.minimum(loss * np.array([contrast for _, contrast in starts]), tuned.START_MOST_LOSS),
        np.full(len(starts), shape),
    )
    tried, value = two_states.maximize(begin, head, law, tuned.START_STEPS)
    model, log_likelihood = two_states.maximize(tried.take([int(np.argmax(value))]), data, law)
    free = 2 + 2 * (law != "constant") + (law == "gamma") + 2 * bool(loss)
    bic = free * math.log(len(lost)) - 2 * float(log_likelihood[0])
    return _Candidate(2, law, bic, model.ordered(law != "constant"))


def _second_state(found: _Candidate, data: Segments, count: int) -> NDArray[np.float64]:
    """Probability of the second state at each of ``count`` transmissions."""
    return np.asarray(two_states.step(found.model, data, found.law)[2][0].ravel()[:count])


def _reject_two_states(found: _Candidate, data: Segments, sent: Transmissions) -> str | None:
    """The reason to reject two states whatever their likelihood, or None."""
    start_ms, _, _ = sent
    second = _second_state(found, data, len(start_ms))
    frames = min(float(second.sum()), float((1 - second).sum()))
    if frames < tuned.MIN_FRAMES:
        return f"one of them rests on {frames:.0f} frames"
    span_ms = float(start_ms[-1] - start_ms[0])
    visits = float(found.model.leave_per_ms[0, 0] * found.model.stationary()[0, 0]) * span_ms
    if visits < tuned.MIN_VISITS:
        return f"the chain changed state {2 * visits:.0f} times only: record longer"
    return None


def _with_intervals(
    chosen: _Candidate, data: Segments, delays_ms: NDArray[np.float64], lost: NDArray[np.float64], count: int
) -> tuple[dict[str, IntervalEstimate], NDArray[np.float64]]:
    """The parameters with their intervals by ``count`` samples, and delays drawn from the fitted distributions (none of
    constant ones)."""
    rng, model, law = np.random.default_rng(0), chosen.model, chosen.law
    many = two_states.draw(model, data, count, rng)
    if chosen.states == 1:
        given = zip(many.delay_ms, many.lost)
        each = [_one_state_parameters(delay[~np.isnan(delay)], fate.ravel(), law) for delay, fate in given]
        mean_ms, loss, shape = np.array(each).T
        again = TwoStates(np.ones((count, 2)), np.stack([mean_ms] * 2, 1), np.stack([loss] * 2, 1), shape)
    else:
        again = two_states.maximize(model.take([0] * count), many, law, tuned.SAMPLE_STEPS)[0]
    values, samples = (_named(each, chosen.states, law) for each in (model, again))
    drawn_ms = np.empty(0)
    if law == "constant":
        values["mean_ms"] = samples["mean_ms"] = np.array([float(delays_ms.mean())])
    else:
        second = two_states.step(model, data, law)[2][~np.isnan(data.delay_ms)]
        means_ms = model.mean_ms[0][(rng.random((count, len(second))) < second).astype(int)].ravel()
        drawn_ms = rng.gamma(model.shape[0], means_ms / model.shape[0])
    if not (lost == 1.0).any():
        values = {name: value for name, value in values.items() if not name.startswith("loss")}
    return {
        name: IntervalEstimate(float(value[0]), _interval(float(value[0]), samples[name], name.startswith("loss")))
        for name, value in values.items()
    }, drawn_ms


def _named(model: TwoStates, states: int, law: str) -> dict[str, NDArray[np.float64]]:
    """The parameters of each sample by name; a loss of nearly nothing is none."""
    loss = np.where(model.loss < tuned.NO_LOSS, 0.0, model.loss)
    pairs = {"mu{}_per_ms": model.leave_per_ms, "mean_{}_ms": model.mean_ms, "loss_{}": loss}
    if states == 1:
        found = {"mean_ms": model.mean_ms[:, 0], "loss": loss[:, 0]}
    else:
        found = {name.format(k + 1): pair[:, k] for name, pair in pairs.items() for k in (0, 1)}
    if law == "constant":
        found = {name: values for name, values in found.items() if not name.startswith("mean")}
    return found | ({"shape": model.shape} if law == "gamma" else {})


def _interval(value: float, samples: NDArray[np.float64], chance: bool) -> Interval:
    """The interval of an estimate by the spread of its samples' logarithms."""
    if value <= 0.0:
        return None if chance else (value, value)
    reach = _Z_95 * float(np.log(np.maximum(samples, 1e-300)).std())
    if not reach < _Z_95 * tuned.MAX_LOG_SD:
        return None
    return value * math.exp(-reach), min(value * math.exp(reach), 1.0 if chance else math.inf)


def _misfit_warnings(delays_ms: NDArray[np.float64], drawn_ms: NDArray[np.float64]) -> list[str]:
    """A warning if the delays are not distributed as those that the fit draws (Kolmogorov-Smirnov distance)."""
    ordered, drawn = np.sort(delays_ms), np.sort(drawn_ms)
    below = np.searchsorted(drawn, ordered, side="right") / len(drawn)
    n = len(ordered)
    distance = max((np.arange(1, n + 1) / n - below).max(), (below - np.arange(n) / n).max())
    if distance * math.sqrt(n) <= tuned.MISFIT:
        return []
    return [
        f"the delays are not exponential or gamma by state (their distribution differs by {distance:.3f}): the means "
        "hold, shapes do not; --service trace:FILE of simulate replays the delays themselves"
    ]


def _arrivals(recording: Recording) -> tuple[str, float]:
    """The arrival process, and the median gap between offers in ms."""
    gaps = np.concatenate([np.diff(camera.offered_ms) for camera in recording.cameras])
    if not len(gaps):
        return "as-offered", 0.0
    median = float(np.median(gaps))
    if recording.sampled:
        return "poisson", median
    near = np.abs(gaps - median) <= tuned.NEAR_MEDIAN * median
    return ("periodic" if near.mean() > tuned.PERIODIC_SHARE else "poisson"), median


def _arrival_rate(recording: Recording) -> IntervalEstimate:
    """Rate of Poisson arrivals: their number over the time in which a camera waited for one."""
    arrivals, waited_ms = 0, 0.0
    for camera in recording.cameras:
        if recording.sampled:
            until = np.append(camera.offered_ms[1:], camera.offered_ms[-1])
            taken = ~np.isnan(camera.arrived_ms)
            waited_ms += float((np.where(taken, camera.arrived_ms, until) - camera.offered_ms).sum())
            arrivals += int(taken.sum())
        else:
            waited_ms += float(camera.offered_ms[-1] - camera.offered_ms[0])
            arrivals += len(camera.offered_ms) - 1
    rate = max(arrivals, 1) / max(waited_ms, 1e-6)
    reach = math.exp(_Z_95 / math.sqrt(max(arrivals, 1)))
    return IntervalEstimate(rate, (rate / reach, rate * reach))


def _channel_section(
    recording: Recording, parameters: dict[str, IntervalEstimate], law: str, arrivals: str, period_ms: float
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
        section["arrivals"]["rate_per_ms"] = number("rate_per_ms")
    if "mu1_per_ms" in parameters:
        rates = {name: number(name) for name in ("mu1_per_ms", "mu2_per_ms")}
        section["chain"] = {**rates, "states": ["low", "high"], "scope": "shared"}
    mean = by_state("mean_ms", "mean_{}_ms")
    name = {"constant": "deterministic"}.get(law, law)
    section["service"] = {"law": "none"} if mean == 0.0 else {"law": name, "mean_ms": mean}
    if law == "gamma":
        section["service"]["shape"] = number("shape")
    section["discipline"] = recording.discipline
    if "loss" in parameters or "loss_1" in parameters:
        section["faults"] = {"loss": {"probability": by_state("loss", "loss_{}")}}
    return section
