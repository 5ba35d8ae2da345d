"""What ``fit`` says of channels whose parameters are known, and of recordings that allow no answer."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
import yaml

from channel_emu.cli import main
from channel_emu.estimate import hmm
from channel_emu.estimate import hmm_kernels as kernel
from channel_emu.estimate import recording as recordings
from channel_emu.estimate.fit import Fit, IntervalEstimate, fit
from channel_emu.estimate.hmm import Timeline, TwoStateModel
from channel_emu.model.chain import transition_matrix, two_state_generator
from channel_emu.model.config import channel_from_mapping
from channel_emu.model.link import FITTED_DISCIPLINES
from freshfield import scenario
from tests.channel_emu.estimate.recordings import write_rows, write_trace
from tests.channel_emu.live.emulator import emulate
from tests.channel_emu.live.test_frame_stream import FAST

# A slow Gilbert-Elliott channel: periodic frames, delays of 20 and 120 ms.
GILBERT = {
    "arrivals": {"process": "periodic", "period_ms": 30.0},
    "chain": {"mu1_per_ms": 1 / 1000, "mu2_per_ms": 1 / 500},
    "service": {"law": "exponential", "mean_ms": [20.0, 120.0]},
    "discipline": "drop-new",
}
GILBERT_TRUE = {"mu1_per_ms": 1 / 1000, "mu2_per_ms": 1 / 500, "mean_1_ms": 20.0, "mean_2_ms": 120.0}
# The thesis's chapter 6, where a state lasts no longer than a frame's gap.
CH6_TRUE = {
    "mu1_per_ms": 1 / 30,
    "mu2_per_ms": 1 / 30,
    "mean_1_ms": 30.0,
    "mean_2_ms": 60.0,
    "rate_1_per_ms": 1 / 120,
    "rate_2_per_ms": 1 / 30,
}
SLOW_TRUE = {**CH6_TRUE, "mu1_per_ms": 1 / 3000, "mu2_per_ms": 1 / 3000}


def holds(found: IntervalEstimate, true: float, widened: float = 1.0) -> bool:
    """Whether the interval, widened about the value on the logarithmic scale, holds the truth."""
    assert found.interval is not None
    low, high = (math.log(v / found.value) * widened for v in found.interval)
    return low <= math.log(true / found.value) <= high


def check(found: Fit, true: dict[str, float]) -> None:
    """Each parameter within one and a half times the reach of its interval (three standard deviations), and
    no interval so wide that it says nothing. How often the intervals themselves hold is a slow test."""
    assert found.states == 2 and not found.warnings
    assert set(found.parameters) == set(true)
    for name, value in true.items():
        assert holds(found.parameters[name], value, 1.5), (name, found.parameters[name], value)
        interval = found.parameters[name].interval
        assert interval is not None and interval[1] / interval[0] < 3.5


@pytest.mark.parametrize("seed", [1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_recovers_a_slow_chain_from_delays_alone(tmp_path: Path, seed: int) -> None:
    found = fit(write_trace(tmp_path / "t.jsonl", GILBERT, seed, cameras=2, seconds=120))
    assert found.arrivals == "periodic" and found.bic[2] < found.bic[1] - 100
    check(found, GILBERT_TRUE)
    section = channel_from_mapping(found.channel)
    assert section.discipline == "drop-new" and section.arrivals.period_ms == pytest.approx(30)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("preset", "true"), [pytest.param("ch6", CH6_TRUE, marks=pytest.mark.slow), ("ch6-slow", SLOW_TRUE)]
)
def test_recovers_the_thesis_channel_from_delays_and_arrivals(
    tmp_path: Path, preset: str, true: dict[str, float], seed: int
) -> None:
    found = fit(write_trace(tmp_path / "t.jsonl", {"preset": preset}, seed, cameras=4, seconds=120))
    assert found.arrivals == "poisson"
    check(found, true)


@pytest.mark.slow  # 5 s
def test_recovers_rates_from_frames_that_arrivals_sampled(tmp_path: Path) -> None:
    """As on a live link: cameras offer every 33 ms, the arrivals take the newest frame or none."""
    path = write_trace(tmp_path / "t.jsonl", {"preset": "ch6-slow"}, 4, cameras=2, seconds=120, frame_period_ms=33.3)
    found = fit(path)
    assert found.recording.sampled
    check(found, SLOW_TRUE)


def test_frames_that_waited_to_be_served_do_not_bias_the_rate(tmp_path: Path) -> None:
    """A frame that found the link busy was sampled some time after its offer, and served later still."""
    section = {"preset": "ch6-high", "service": {"mean_ms": 150.0}}
    path = write_trace(tmp_path / "t.jsonl", section, 4, cameras=6, seconds=200, frame_period_ms=90.0)
    found = fit(path, "1").parameters["rate_per_ms"]
    assert found.interval is not None and found.interval[1] / found.interval[0] < 1.05
    assert holds(found, 1 / 60)


def test_cameras_with_chains_of_their_own(tmp_path: Path) -> None:
    section = {**GILBERT, "chain": {**GILBERT["chain"], "scope": "per-camera"}}
    path = write_trace(tmp_path / "t.jsonl", section, 5, cameras=3, seconds=120)
    found = fit(path, scope="per-camera")
    check(found, GILBERT_TRUE)
    assert channel_from_mapping(found.channel).chain == msgspec.structs.replace(
        channel_from_mapping(section).chain,
        mu1_per_ms=found.channel["chain"]["mu1_per_ms"],
        mu2_per_ms=found.channel["chain"]["mu2_per_ms"],
        states=["low", "high"],
    )
    # One chain for all of them explains these delays worse.
    assert fit(path, "2").bic[2] > found.bic[2] + 100


def test_recorded_states_are_not_used(tmp_path: Path) -> None:
    path = write_trace(tmp_path / "t.jsonl", GILBERT, 6, seconds=80)
    blind = tmp_path / "blind.jsonl"
    blind.write_text(path.read_text().replace('"state":1', '"state":0'))
    assert fit(path).parameters == fit(blind).parameters


@pytest.mark.parametrize(
    "section",
    [
        {"preset": "ch5"},
        {"preset": "ch6-high"},
        {"preset": "ch6-low"},
        {"preset": "ch5", "service": {"law": "gamma", "mean_ms": 60.0, "shape": 2.0}},
    ],
    ids=["ch5", "ch6-high", "ch6-low", "gamma"],
)
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow), 3])
def test_one_state_is_not_made_two(tmp_path: Path, section: dict, seed: int) -> None:
    found = fit(write_trace(tmp_path / "t.jsonl", section, seed, cameras=2, seconds=45))
    assert found.states == 1 and "chain" not in found.channel
    true = channel_from_mapping(section)
    law, rate = true.service, true.arrivals.rate_per_ms
    if law.law == "exponential":
        assert holds(found.parameters["mean_ms"], law.mean_ms, 1.5) and not found.warnings
    else:
        assert found.parameters["mean_ms"].value == pytest.approx(law.mean_ms, rel=0.1)
        assert "not exponential" in found.warnings[0]
    assert rate is None or holds(found.parameters["rate_per_ms"], rate, 1.5)


@pytest.mark.slow
def test_intervals_hold_the_truth_as_often_as_they_say(tmp_path: Path) -> None:
    """40 recordings of four parameters: 95 % of 160 is 152, and fewer than 143 has a chance of 1 in 300."""
    inside = 0
    for seed in range(40):
        found = fit(write_trace(tmp_path / "t.jsonl", GILBERT, 100 + seed, cameras=1, seconds=90))
        inside += sum(holds(found.parameters[name], value) for name, value in GILBERT_TRUE.items())
    assert inside >= 143


def test_rows_of_any_link_give_the_same_channel(tmp_path: Path) -> None:
    found = fit(write_rows(tmp_path / "rows.csv", GILBERT, 7, seconds=120))
    check(found, GILBERT_TRUE)
    assert found.bursts["lost_share"].value == 0
    # The same rows behind a waiting place: transmission starts when the link becomes free.
    waits = {**GILBERT, "discipline": "newest-waits"}
    path = write_rows(tmp_path / "rows.csv", waits, 7, seconds=120)
    with pytest.raises(recordings.RecordingError, match=r"% of the frames .* --discipline"):
        fit(path)
    found = fit(path, discipline="newest-waits")
    check(found, GILBERT_TRUE)
    assert found.channel["discipline"] == "newest-waits"


def test_losses_and_their_runs(tmp_path: Path) -> None:
    section = {
        "arrivals": {"process": "periodic", "period_ms": 10.0},
        "discipline": "parallel",
        "service": {"law": "exponential", "mean_ms": 5.0},
        "faults": {"loss": {"probability": 0.2}},
    }
    found = fit(write_trace(tmp_path / "t.jsonl", section, 8, cameras=2, seconds=60))
    low, high = found.bursts["lost_share"].interval or (0, 0)
    assert low < 0.2 < high and high - low < 0.04
    # Independent losses of one in five: runs of 1 / .8 on average.
    low, high = found.bursts["run_of_missing_frames"].interval or (0, 0)
    assert low < 1.25 < high and high - low < 0.1
    assert found.channel["faults"] == {"loss": {"probability": pytest.approx(0.2, abs=0.02)}}
    assert found.bursts["dropped_share"].value == 0


def test_drops_of_a_busy_link_come_in_runs(tmp_path: Path) -> None:
    """D/M/1/0: of ceil(S/C) frames all but the first are dropped, so a run lasts 1/(1 - e^(-mu C))."""
    found = fit(write_trace(tmp_path / "t.jsonl", {"preset": "ch5"}, 9, cameras=4, seconds=120))
    low, high = found.bursts["run_of_missing_frames"].interval or (0, 0)
    assert low < 1 / (1 - math.exp(-0.5)) < high and high - low < 0.25
    low, high = found.bursts["dropped_share"].interval or (0, 0)
    assert low < math.exp(-0.5) < high
    low, high = found.bursts["gap_ms"].interval or (0, 0)
    assert low < 30 / (1 - math.exp(-0.5)) < high


@pytest.mark.parametrize(
    ("rows", "why"),
    [
        ("", "there is no frame in it"),
        ("offered_ms,delivered_ms\n", "there is no frame in it"),
        ("0,5\n30,40\n", "2 delays .2 frames, 2 came.; at least 20 are needed"),
        ("".join(f"{30 * n},\n" for n in range(100)), "none of its 100 frames came through"),
        ("".join(f"{30 * n},{1e11 + n}\n" for n in range(100)), "none of its 100 frames came through"),
        ("0,5\n30,20\n", "line 2: expected offered_ms, delivered_ms"),
        ("0,5\nrain\n", "line 2: expected offered_ms"),
        ("0,5\nnan,7\n", "line 2: expected offered_ms"),
        ("0;7,5\n30;37,5\n", "line 1: expected .* numbers with a point, one separator"),
        ("offered_ms;delivered_ms\n0,5\n", "line 2: expected .* numbers with a point, one separator"),
        ("0\t7,5\n", "line 1: expected .* numbers with a point, one separator"),
    ],
)
def test_nothing_to_fit_is_said_in_one_line(tmp_path: Path, capsys, rows: str, why: str) -> None:
    path = tmp_path / "rows.csv"
    path.write_text(rows)
    assert main(["fit", str(path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    with pytest.raises(ValueError, match=why):
        fit(path)


def test_constant_delays_are_one_state_of_constant_delays(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    path.write_text("".join(f"{30 * n}, {30 * n + 12.5}\n" for n in range(200)))
    found = fit(path)
    assert found.states == 1 and found.channel["service"] == {"law": "deterministic", "mean_ms": 12.5}
    assert "hardly vary" in found.warnings[0]
    with pytest.raises(ValueError, match="nothing to tell states by"):
        fit(path, "2")
    path.write_text("".join(f"{30 * n}, {30 * n}\n" for n in range(200)))
    assert fit(path).channel["service"] == {"law": "none"}


def test_a_few_huge_delays_are_no_state(tmp_path: Path) -> None:
    path = write_rows(tmp_path / "rows.csv", {"preset": "ch5", "discipline": "parallel"}, 3, seconds=30)
    lines = path.read_text().splitlines()
    for n, delay in ((100, 5e5), (400, 7e6), (700, 3e12)):
        offered = float(lines[n].split(",")[0])
        lines[n] = f"{offered},{offered + delay}"
    path.write_text("\n".join(lines))
    found = fit(path, discipline="parallel")
    assert found.states == 1
    assert any("rests on 2 frames" in w for w in found.warnings)
    assert any("1 frames took longer than 1e+09 ms" in w for w in found.warnings)


def test_the_command_writes_a_scenario_and_a_picture(tmp_path: Path, capsys) -> None:
    path = write_trace(tmp_path / "t.jsonl", GILBERT, 1, seconds=60)
    words = ["fit", str(path), "--out", str(tmp_path / "f.yaml"), "--plot", str(tmp_path / "f.png")]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "mu1_per_ms" in text and "that of two is" in text
    shown = yaml.safe_load(text[text.index("channel:") :])["channel"]
    assert channel_from_mapping(shown) == channel_from_mapping(scenario.load(tmp_path / "f.yaml").channel)
    assert (tmp_path / "f.png").read_bytes().startswith(b"\x89PNG")
    assert main(["simulate", "--scenario", str(tmp_path / "f.yaml"), "--seconds", "60"]) == 0
    capsys.readouterr()
    assert main(["fit", str(path), "--json", "--states", "1"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["states"] == 1 and found["chosen_by"] == "asked"
    with pytest.raises(SystemExit):
        main(["fit", str(path), "--plot", str(path / "no" / "f.png")])
    assert "argument --plot: " in capsys.readouterr().err


MODEL = TwoStateModel(np.array([0.02, 0.05]), np.array([20.0, 90.0]), np.array([0.01, 0.04]))


def line_of(n: int = 60, seed: int = 0) -> Timeline:
    rng = np.random.default_rng(seed)
    delay = rng.exponential(50.0, n)
    arrived = rng.random(n) < 0.5
    delay[rng.random(n) < 0.3] = np.nan
    return Timeline(rng.exponential(20.0, n), rng.integers(0, 3, n), arrived, delay)


def quiet(span_ms: np.ndarray, waiting: int) -> Timeline:
    """Spans at whose ends nothing happens."""
    n = len(span_ms)
    return Timeline(span_ms, np.full(n, waiting), np.zeros(n, np.bool_), np.full(n, np.nan))


def test_without_arrivals_a_step_is_the_chains_transition_matrix() -> None:
    span_ms = np.array([0.0, 1e-9, 0.3, 40.0, 1e5])
    silent = dataclasses.replace(MODEL, rate_per_ms=None)
    steps = hmm._propagators(silent, quiet(span_ms, 3))
    for span, step in zip(span_ms, steps):
        assert step == pytest.approx(transition_matrix(two_state_generator(0.02, 0.05), span), abs=1e-14)


def test_a_step_against_small_time_steps() -> None:
    """exp(G u) by ten thousand short steps of the defining equation."""
    span_ms, parts = 35.0, 10_000
    rates = MODEL.rate_per_ms
    assert rates is not None
    generator = two_state_generator(*MODEL.leave_per_ms) - 2 * np.diag(rates)
    h = span_ms / parts
    short = np.eye(2) + h * generator + h * h / 2 * generator @ generator
    step = hmm._propagators(MODEL, quiet(np.array([span_ms]), 2))[0]
    assert step == pytest.approx(np.linalg.matrix_power(short, parts), rel=1e-6)


def test_the_kernel_agrees_with_sums_over_all_paths() -> None:
    """Eight observations, every one of the 2^9 paths: likelihood and probabilities of the states."""
    line = line_of(8)
    steps, (seen, _) = hmm._propagators(MODEL, line), hmm._emissions(MODEL, line)
    total, states = 0.0, np.zeros((8, 2))
    for path in np.ndindex(*[2] * 9):
        p = 0.5 * math.prod(steps[k, path[k], path[k + 1]] * seen[k, path[k + 1]] for k in range(8))
        total += p
        for k in range(8):
            states[k, path[k + 1]] += p
    even = np.array([0.5, 0.5])
    assert kernel.forward(even, steps, seen)[0] == pytest.approx(math.log(total), rel=1e-12)
    assert kernel.smooth(even, steps, seen) == pytest.approx(states / total, rel=1e-10)


def test_the_maximum_is_flat_and_higher_than_all_around_it(tmp_path: Path) -> None:
    path = write_trace(tmp_path / "t.jsonl", GILBERT, 1, cameras=1, seconds=60)
    lines = recordings.timelines(recordings.read_recording(path), True, False)
    start = hmm.initial_models(lines, True, False)[0]
    found = hmm.maximize(start, lines, hmm.MOST_STEPS)
    at, best = found.log_parameters(), hmm.log_likelihood(found, lines)
    assert best > hmm.log_likelihood(start, lines)
    for move in 0.03 * np.eye(len(at)):
        beside = [hmm.log_likelihood(found.with_logs(at + sign * move), lines) for sign in (-1, 1)]
        assert max(beside) < best and abs(beside[1] - beside[0]) < 0.2 * (2 * best - sum(beside))
    for states in hmm.state_probabilities(found, lines):
        np.testing.assert_allclose(states.sum(axis=1), 1.0, rtol=1e-12)


def test_timelines_count_who_is_waiting(tmp_path: Path) -> None:
    path = write_trace(tmp_path / "t.jsonl", {"preset": "ch6"}, 1, cameras=3, seconds=20, frame_period_ms=33.0)
    recording = recordings.read_recording(path)
    (line,) = recordings.timelines(recording, True, True)
    assert line.waiting.min() >= 0 and line.waiting[line.span_ms > 0].max() == 3
    taken = sum(int((~np.isnan(c.arrived_ms)).sum()) for c in recording.cameras)
    assert line.arrived.sum() == taken > 300
    assert (~np.isnan(line.delay_ms)).sum() == len(recording.delays_ms())
    assert len(recordings.timelines(recording, False, True)) == 3


@pytest.mark.parametrize("seed", [*range(6), *(pytest.param(s, marks=pytest.mark.slow) for s in range(6, 40))])
def test_odd_recordings_give_finite_figures_or_one_line(tmp_path: Path, seed: int) -> None:
    """Frames in one instant or in bursts, delays over sixteen decades, of two values, or of none; nine in ten
    lost. Nothing overflows on the way, and what comes out is a channel."""
    rng = np.random.default_rng(seed)
    n = int(rng.choice([40, 150, 600]))
    gaps = (np.zeros(n), rng.exponential(1, n) ** 6 * 10, rng.choice([0.0, 1e-6, 1e6], n))[seed % 3]
    delays = (
        rng.lognormal(0, 8, n),
        np.where(rng.random(n) < 0.5, 0.0, 1e5 * rng.random(n)),
        np.where(np.arange(n) < n // 2, 1.0, 1e6),
        rng.exponential(50, n) * 1e-7,
    )[seed % 4]
    lost = rng.random(n) < (0.0, 0.3, 0.9)[seed // 3 % 3]
    rows = [
        f"{float(o)!r},{'' if gone else repr(float(o + d))},c{i % 2}\n"
        for i, (o, d, gone) in enumerate(zip(np.cumsum(gaps), delays, lost))
    ]
    path = tmp_path / "rows.csv"
    path.write_text("".join(rows))
    discipline = FITTED_DISCIPLINES[seed % 4]
    with np.errstate(divide="raise", invalid="raise", over="raise"):
        for states in ("auto", "2"):
            try:
                found = fit(path, states, discipline=discipline)
            except recordings.RecordingError as error:
                assert "delay" in str(error) and "\n" not in str(error)
                continue
            assert channel_from_mapping(found.channel).discipline == discipline
            for value in (*found.parameters.values(), *found.bursts.values()):
                assert all(math.isfinite(v) for v in (value.value, *(value.interval or ())))
                assert value.interval is None or value.interval[0] <= value.value <= value.interval[1]


@pytest.mark.slow  # 7 s
def test_faults_leave_the_estimates_alone(tmp_path: Path) -> None:
    """Frames lost, doubled, damaged and cut off by resets, on a link whose arrivals sample frames."""
    chance = {"probability": 0.1}
    faults = {"loss": chance, "duplication": chance, "corruption": chance, "reset": {"mean_interval_ms": 4000.0}}
    section = {"preset": "ch6-slow", "faults": faults}
    found = fit(write_trace(tmp_path / "t.jsonl", section, 6, cameras=2, seconds=120, frame_period_ms=33.3))
    check(found, SLOW_TRUE)
    lost = found.bursts["lost_share"]
    assert lost.interval is not None and lost.interval[1] > 0.1  # resets cost frames beside those lost
    assert 0.1 < found.channel["faults"]["loss"]["probability"] < 0.16


@pytest.mark.slow
@pytest.mark.alone
def test_a_live_recording_is_fitted_to_the_channel_that_made_it(tmp_path: Path) -> None:
    """Some seconds on the wall clock: cameras, emulator and the edge's ingest; only the trace is known."""
    section = {**FAST, "chain": {"mu1_per_ms": 1 / 400, "mu2_per_ms": 1 / 400}}

    async def live() -> None:
        async with emulate(tmp_path, section, trace=tmp_path / "t.jsonl") as r:
            await asyncio.gather(*(c.stream(2000, 0.005) for c in r.cameras.values()))
            await r.settled()

    asyncio.run(live())
    found = fit(tmp_path / "t.jsonl")
    assert found.states == 2 and found.recording.sampled
    true = {
        "mu1_per_ms": 1 / 400,
        "mu2_per_ms": 1 / 400,
        "mean_1_ms": 5.0,
        "mean_2_ms": 10.0,
        "rate_1_per_ms": 1 / 20,
        "rate_2_per_ms": 1 / 5,
    }
    for name, value in true.items():
        # Offers fall as the machine lets them, so this is no fixed sample: four standard deviations.
        assert holds(found.parameters[name], value, 2.0), (name, found.parameters[name])


def test_what_is_still_on_its_way_is_not_lost(tmp_path: Path) -> None:
    """A parallel link recorded until 10 s: late frames that had not come by then are no losses."""
    rng = np.random.default_rng(5)
    offered = np.arange(0.0, 10_000.0, 10.0)
    came = offered + rng.exponential(60.0, len(offered))
    path = tmp_path / "rows.csv"
    path.write_text("".join(f"{o},{c if c <= 10_000 else ''}\n" for o, c in zip(offered, came)))
    assert (came > 10_000).sum() > 2
    (camera,) = recordings.read_recording(path, "parallel").cameras
    assert not (camera.outcome == "lost").any() and (camera.outcome == "").sum() == (came > 10_000).sum()
    # One that is missing long before the end is lost.
    lines = path.read_text().splitlines()
    lines[300] = f"{offered[300]},"
    path.write_text("\n".join(lines))
    (camera,) = recordings.read_recording(path, "parallel").cameras
    assert np.flatnonzero(camera.outcome == "lost").tolist() == [300]


def test_a_trace_without_a_frame_says_so(tmp_path: Path, capsys) -> None:
    path = write_trace(tmp_path / "t.jsonl", {"preset": "ch5"}, 1, seconds=1)
    path.write_text(path.read_text().splitlines()[0] + "\n")
    assert main(["fit", str(path)]) == 2
    assert "there is no frame in it" in capsys.readouterr().err
