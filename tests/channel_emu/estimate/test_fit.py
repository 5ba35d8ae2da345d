"""What ``fit`` says of channels whose parameters are known, and of recordings that allow no answer; its recursions
against sums over all paths and small steps of time."""

import itertools
import math
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy import linalg

from channel_emu.cli import main
from channel_emu.estimate import recording as recordings
from channel_emu.estimate import two_states
from channel_emu.estimate.fit import Fit, fit
from channel_emu.estimate.report import format_fit
from channel_emu.estimate.two_states import TwoStates
from channel_emu.model.chain import two_state_generator
from channel_emu.model.link import FITTED_DISCIPLINES
from channel_emu.model.settings import channel_from_mapping
from channel_emu.model.trace import TraceWriter
from channel_emu.virtual.simulate import simulate
from freshfield import scenario
from tests.support import axes_drawn, refused

RATES = {"mu1_per_ms": 1 / 1000, "mu2_per_ms": 1 / 500}
# A slow channel: periodic frames, delays of 20 and 120 ms.
SLOW = {
    "arrivals": {"process": "periodic", "period_ms": 30.0},
    "chain": RATES,
    "service": {"law": "exponential", "mean_ms": [20.0, 120.0]},
    "discipline": "drop-new",
}
HEAD = "offered_ms,delivered_ms\n"
SLOW_TRUE = {**RATES, "mean_1_ms": 20.0, "mean_2_ms": 120.0}


def write_trace(path: Path, section: dict, seed: int, cameras: int, seconds: float, **more) -> Path:
    """A trace as the live emulator would leave it."""
    config = channel_from_mapping(section)
    writer = TraceWriter(path, config, seed)
    for run in simulate(config, cameras, seconds, seed, **more).runs:
        for transit in run.transits:
            writer.write(run.camera, "s", transit.number, transit)
    writer.close()
    return path


def write_rows(path: Path, section: dict, seed: int = 1, seconds: float = 120.0) -> Path:
    """offered_ms, delivered_ms of one camera; what did not come is blank, without a word why."""
    simulate(channel_from_mapping(section), 1, seconds, seed).write_frames(path)
    path.write_text("".join(line.rpartition(",")[0] + "\n" for line in path.read_text().splitlines()))
    return path


def check(found: Fit, true: dict[str, float]) -> None:
    """Each parameter within one and a half times the reach of its interval (three standard deviations), and
    no interval so wide that it says nothing."""
    assert found.states == (2 if "mu1_per_ms" in true else 1) and set(found.parameters) == set(true)
    for name, value in true.items():
        parameter = found.parameters[name]
        low, high = (1.5 * math.log(end / parameter.value) for end in parameter.interval)
        assert low <= math.log(value / parameter.value) <= high, (name, parameter, value)
        assert parameter.interval[1] / parameter.interval[0] < 3.5


def test_a_slow_chain_from_delays_alone(tmp_path):
    found = fit(write_trace(tmp_path / "t.jsonl", SLOW, 1, cameras=2, seconds=120))
    assert found.arrivals == "periodic" and found.bic[2] < found.bic[1] - 100 and not found.warnings
    check(found, SLOW_TRUE)
    section = channel_from_mapping(found.channel)
    assert section.discipline == "drop-new" and section.arrivals.period_ms == pytest.approx(30)
    assert "faults" not in found.channel and found.channel["service"]["law"] == "exponential"
    mu1, mu2 = (found.parameters[f"mu{k}_per_ms"].value for k in (1, 2))
    low, high = found.channel["chain"]["states"]
    visits = f"  a visit lasts {1 / mu1:.4g} ms in {low}, {1 / mu2:.4g} ms in {high}; shares of time "
    assert f"{visits}{mu2 / (mu1 + mu2):.3f}, {mu1 / (mu1 + mu2):.3f}" in format_fit(found).splitlines()
    for name, value in found.parameters.items():
        low, high = value.interval
        assert re.search(rf"{name} +{value.value:.5g}  \[{low:.5g}, {high:.5g}\]", format_fit(found)), name


def test_delays_and_losses_together_and_a_shape(tmp_path):
    service = {"law": "gamma", "mean_ms": [20.0, 60.0], "shape": 4.0}
    section = {**SLOW, "service": service, "faults": {"loss": [0.01, 0.3]}, "discipline": "parallel"}
    found = fit(write_rows(tmp_path / "rows.csv", section), discipline="parallel")
    check(found, {**RATES, "mean_1_ms": 20.0, "mean_2_ms": 60.0, "loss_1": 0.01, "loss_2": 0.3, "shape": 4.0})
    assert found.channel["service"]["law"] == "gamma" and not found.warnings


def test_one_state_and_arrivals_that_sample_frames(tmp_path):
    """The thesis's traffic in its low state: arrivals of one rate, delays of one mean, independent losses."""
    section = {"preset": "ch6-low", "faults": {"loss": 0.2}}
    found = fit(write_trace(tmp_path / "t.jsonl", section, 4, cameras=4, seconds=120, frame_period_ms=33.3))
    assert found.arrivals == "poisson" and found.recording.sampled
    check(found, {"mean_ms": 30.0, "loss": 0.2, "rate_per_ms": 1 / 120})
    assert found.channel["discipline"] == "newest-waits"


def test_cameras_of_chains_of_their_own_are_not_fitted_as_one(tmp_path):
    section = {**SLOW, "chain": {**RATES, "scope": "per-camera"}}
    path = write_trace(tmp_path / "t.jsonl", section, 1, cameras=2, seconds=120)
    refused(recordings.RecordingError, "a chain of its own", fit, path)
    path.write_text("".join(line for line in path.read_text().splitlines(True) if '"cam01"' not in line))
    check(fit(path), SLOW_TRUE)


def test_rows_behind_a_waiting_place(tmp_path):
    """Transmission starts when the link becomes free; without a word of it the waiting would count as delay."""
    path = write_rows(tmp_path / "rows.csv", {**SLOW, "discipline": "newest-waits"}, 7)
    refused(recordings.RecordingError, r"% of the frames .* --discipline", fit, path)
    check(fit(path, discipline="newest-waits"), SLOW_TRUE)


@pytest.mark.parametrize("discipline", ["fcfs", "newest-waits"])
def test_lost_frames_that_had_waited_are_losses(tmp_path, discipline):
    """A frame behind a lost one starts nobody knows when: its delay is left out."""
    section = {"arrivals": "periodic:30ms", "service": "exp:24ms", "faults": {"loss": 0.1}, "discipline": discipline}
    simulate(channel_from_mapping(section), 1, 300).write_frames(tmp_path / "rows.csv")
    check(fit(tmp_path / "rows.csv", discipline=discipline), {"mean_ms": 24.0, "loss": 0.1})


def test_what_is_still_on_its_way_is_not_lost(tmp_path):
    """A parallel link recorded until 10 s: late frames that had not come by then are no losses, and one that is
    missing long before is."""
    offered = np.arange(0.0, 10_000.0, 10.0)
    came = offered + np.random.default_rng(5).exponential(60.0, len(offered))
    came[300] = np.inf
    path = tmp_path / "rows.csv"
    path.write_text(HEAD + "".join(f"{o},{c if c <= 10_000 else ''}\n" for o, c in zip(offered, came)))
    (camera,) = recordings.read_recording(path, "parallel").cameras
    assert np.flatnonzero(camera.outcome == "lost").tolist() == [300]
    assert (camera.outcome == "").sum() == (came > 10_000).sum() - 1 > 2


def test_nothing_to_fit_is_said_in_one_line(tmp_path):
    for rows, why in (
        (HEAD, "there is no frame in it"),
        (HEAD + "0,5\n30,40\n", "2 delays below .* .2 frames, 2 came.; at least 20 are needed"),
        (HEAD + "".join(f"{30 * n},\n" for n in range(100)), "0 delays below 1e.09 ms .100 frames, 0 came."),
        (HEAD + "0,5\n30,20\n", "line 3: delivered_ms is not earlier than offered_ms, or blank: 30, 20"),
        (HEAD + "0,5\n1e12,\n1.1e12,\n", "line 4: offered_ms is decades away from the first: 1.1e12, "),
        (HEAD + '"' + 140_000 * "0", "cannot be read as a table: field larger than"),
        (HEAD[:-1] + ",outcome\n0,5,delivered\n30,,drop\n", "line 3: outcome is 'drop', expected delivered, lost, "),
        (HEAD[:-1] + ",outcome\n0,,skipped\n", "sampled the frames .* or fit a --trace"),
        ("0,5\n30,40\n", "expected a header with the columns offered_ms, .* it has no header"),
    ):
        (tmp_path / "rows.csv").write_text(rows)
        refused(ValueError, why, fit, tmp_path / "rows.csv")


def test_constant_delays_are_one_state_of_constant_delays(tmp_path):
    path = tmp_path / "rows.csv"
    path.write_text("\ufeff" + HEAD + "".join(f"{30 * n}, {30 * n + 12.5}\n" for n in range(200)))
    found = fit(path)
    assert found.states == 1 and found.channel["service"] == {"law": "deterministic", "mean_ms": 12.5}
    assert "hardly vary" in found.warnings[0]
    refused(ValueError, "nothing to tell states by", fit, path, "2")
    path.write_text(HEAD + "".join(f"{30 * n}, {30 * n}\n" for n in range(200)))
    assert fit(path).channel["service"] == {"law": "none"}


def test_a_few_huge_delays_are_no_state(tmp_path):
    path = write_rows(tmp_path / "rows.csv", {"preset": "ch5", "discipline": "parallel"}, 3, seconds=30)
    lines = path.read_text().splitlines()
    for n, delay in ((100, 5e5), (400, 7e6), (700, 3e12)):
        offered = float(lines[n].split(",")[0])
        lines[n] = f"{offered},{offered + delay}"
    path.write_text("\n".join(lines))
    found = fit(path, discipline="parallel")
    assert found.states == 1
    assert any("rests on 2 frames" in w for w in found.warnings)


def test_the_command_writes_a_scenario_and_a_picture(tmp_path, capsys, monkeypatch):
    drawn = axes_drawn(monkeypatch)
    path = write_trace(tmp_path / "t.jsonl", SLOW, 1, 2, seconds=60)
    assert main(["fit", str(path), "--out", str(tmp_path / "f.yaml"), "--plot", str(tmp_path / "f.png")]) == 0
    text = capsys.readouterr().out
    assert "mu1_per_ms" in text and "that of two is" in text
    shown = yaml.safe_load(text[text.index("channel:") :])["channel"]
    assert channel_from_mapping(shown) == channel_from_mapping(scenario.load(tmp_path / "f.yaml").channel)
    assert (tmp_path / "f.png").read_bytes().startswith(b"\x89PNG")
    ((delays, chance),) = drawn
    start_s, delay_ms = delays.collections[0].get_offsets().data.T
    at_s, second = chance.lines[0].get_data()
    assert at_s[0] <= start_s.min() + 1 and start_s.max() - 1 <= at_s[-1] <= start_s.max() < 60.5
    slow = np.interp(start_s, at_s, second) > 0.5
    assert np.nanmean(delay_ms[slow]) > 3 * np.nanmean(delay_ms[~slow])
    assert [line.get_label().split(":")[0] for line in delays.lines] == ["mean_1_ms", "mean_2_ms"]


@pytest.mark.stability
@pytest.mark.parametrize("seed", [*range(3), *(pytest.param(k, marks=pytest.mark.slow) for k in range(3, 8))])
def test_odd_recordings_give_finite_figures_or_one_line(tmp_path, seed):
    """Frames in one instant or in bursts, delays over sixteen decades, of two values, or of none; nine in ten
    lost. Nothing overflows on the way, and what comes out is a channel."""
    rng = np.random.default_rng(seed)
    n = int(rng.choice([40, 80, 150]))
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
    path.write_text("offered_ms,delivered_ms,camera\n" + "".join(rows))
    discipline = FITTED_DISCIPLINES[seed % 4]
    with np.errstate(divide="raise", invalid="raise", over="raise"):
        for states in ("auto", "2"):
            try:
                found = fit(path, states, discipline=discipline, samples=5)
            except recordings.RecordingError as error:
                assert "delay" in str(error) and "\n" not in str(error)
                continue
            assert channel_from_mapping(found.channel).discipline == discipline
            for value in found.parameters.values():
                assert all(math.isfinite(v) for v in (value.value, *(value.interval or ())))
                assert value.interval is None or value.interval[0] <= value.value <= value.interval[1]


LEAVE, MEAN, LOSS = (0.02, 0.05), (20.0, 90.0), (0.05, 0.4)
MODEL = TwoStates(np.array([LEAVE]), np.array([MEAN]), np.array([LOSS]), np.array([1.0]))
START_MS = np.array([0.0, 12.0, 13.0, 70.0, 71.0, 400.0])
DELAY_MS = np.array([5.0, 100.0, np.nan, 15.0, np.nan, 60.0])
LOST = np.array([0.0, 0.0, 1.0, 1.0, np.nan, 0.0])


def likelihood(state: int, k: int) -> float:
    """Of frame k, written out."""
    density = 1.0 if math.isnan(DELAY_MS[k]) else math.exp(-DELAY_MS[k] / MEAN[state]) / MEAN[state]
    return density * {0.0: 1 - LOSS[state], 1.0: LOSS[state]}.get(float(LOST[k]), 1.0)


def test_likelihood_states_and_losses_are_sums_over_all_paths():
    q, count = two_state_generator(*LEAVE), len(START_MS)
    steps = [linalg.expm(q * span) for span in np.diff(START_MS)]
    share = (LEAVE[1] / sum(LEAVE), LEAVE[0] / sum(LEAVE))
    total, states = 0.0, np.zeros((count, 2))
    for path in itertools.product((0, 1), repeat=count):
        p = share[path[0]] * math.prod(likelihood(s, k) for k, s in enumerate(path))
        p *= math.prod(step[a, b] for step, a, b in zip(steps, path, path[1:]))
        total += p
        states[range(count), path] += p
    states /= total
    data = two_states.segments((START_MS, DELAY_MS, LOST), True)
    after, log_likelihood, second = two_states.step(MODEL, data, "exponential")
    assert log_likelihood[0] == pytest.approx(math.log(total), rel=1e-12)
    assert second[0, 0] == pytest.approx(states[:, 1], rel=1e-10)
    known, came = ~np.isnan(LOST), ~np.isnan(DELAY_MS)
    assert after.loss[0] == pytest.approx((LOST[known] @ states[known]) / states[known].sum(0))
    assert after.mean_ms[0] == pytest.approx((DELAY_MS[came] @ states[came]) / states[came].sum(0))


def test_a_step_gives_the_expected_jumps_over_the_expected_time():
    """Two frames 40 ms apart, and the way between them in four thousand steps of the chain."""
    parts, span = 4000, 40.0
    start, delay, lost = np.array([0.0, span]), np.array([5.0, 150.0]), np.array([0.0, 0.0])
    after, _, _ = two_states.step(MODEL, two_states.segments((start, delay, lost), True), "exponential")
    q, h = two_state_generator(*LEAVE), span / parts
    small = linalg.expm(q * h)
    ahead = np.empty((parts + 1, 2))
    back = np.empty((parts + 1, 2))
    ahead[0] = [LEAVE[1 - k] / sum(LEAVE) * math.exp(-5.0 / MEAN[k]) / MEAN[k] * (1 - LOSS[k]) for k in (0, 1)]
    back[-1] = [math.exp(-150.0 / MEAN[k]) / MEAN[k] * (1 - LOSS[k]) for k in (0, 1)]
    for k in range(parts):
        ahead[k + 1] = ahead[k] @ small
        back[-k - 2] = small @ back[-k - 1]
    time_in = (ahead * back)[:-1].sum(0) * h
    jumps = [(ahead[:-1, k] * small[k, 1 - k] * back[1:, 1 - k]).sum() for k in (0, 1)]
    assert after.leave_per_ms[0] == pytest.approx(np.array(jumps) / time_in, rel=2e-3)


def test_the_maximum_is_reached_in_a_dozen_steps():
    base = two_states.segments((np.arange(1500) * 30.0, np.ones(1500), np.zeros(1500)), False)
    data = two_states.draw(MODEL, base, 1, np.random.default_rng(1))
    best = two_states.maximize(MODEL, data, "gamma")[1]
    far = TwoStates(MODEL.leave_per_ms * [[3.0, 0.3]], MODEL.mean_ms * [[2.0, 0.7]], np.full((1, 2), 0.2), MODEL.shape)
    assert two_states.maximize(far, data, "gamma", 12)[1] > best - 0.05
