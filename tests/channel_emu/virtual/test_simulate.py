from __future__ import annotations

import sys

import numpy as np
import pytest

from channel_emu.model.channel import Channel
from channel_emu.model.config import channel_from_mapping
from channel_emu.model.link import DISCIPLINES
from channel_emu.virtual.link_run import OUTCOMES, LinkRun
from channel_emu.virtual.replay import offer_all
from channel_emu.virtual.simulate import SimulationError, simulate
from edge_server.live.buffer import FrameBuffer
from tests.channel_emu.live.emulator import frame_of

EXPONENTIAL = {"law": "exponential", "mean_ms": [30.0, 60.0]}


def same(a: LinkRun, b: LinkRun) -> None:
    """Every decision alike; what is due after the end may be unknown to the kernel."""
    np.testing.assert_array_equal(a.offered_ns, b.offered_ns)
    np.testing.assert_array_equal(a.outcome, b.outcome)
    np.testing.assert_array_equal(a.started_ns, b.started_ns)
    known = a.due_ns <= a.end_ns
    np.testing.assert_array_equal(a.due_ns[known], b.due_ns[known])
    assert a.state_share == pytest.approx(b.state_share, abs=1e-12)


CHANNELS = [
    *({"preset": p} for p in ("ideal", "ch5", "ch6", "ch6-high", "ch6-low", "ch6-slow", "swing", "gilbert-elliott")),
    *({"preset": "ch6", "discipline": d, "service_state": s} for d in DISCIPLINES for s in ("at-start", "modulated")),
    *(
        {"preset": "ch6", "discipline": d, "queue_limit": 2, "chain": {"scope": "per-camera"}}
        for d in ("fcfs", "parallel")
    ),
    *(
        {
            "preset": "ch6",
            "discipline": "fcfs",
            "service_state": s,
            "chain": {"sampled": "slots", "slot_ms": slot_ms, **more},
        }
        for s in ("at-start", "modulated")
        for slot_ms, more in ((1.0, {}), (7.3, {"scope": "per-camera"}))
    ),
    {"preset": "ch6", "chain": {"mu1_per_ms": 1e9, "mu2_per_ms": 1e9, "sampled": "slots", "slot_ms": 0.5}},
    {
        "preset": "ch6",
        "chain": {"mu1_per_ms": 0.01, "mu2_per_ms": 0.0, "initial": "low", "sampled": "slots", "slot_ms": 2.0},
    },
    {"preset": "ch5", "arrivals": {"spread": True}},
    *(
        {"preset": "ch6", "discipline": d, "faults": {"loss": [0.1, 0.6]}, "chain": {"scope": "per-camera"}}
        for d in ("drop-new", "newest-waits")
    ),
    {"preset": "ch6", "server": {"shared": True}, "faults": {"loss": 0.3}},
    *(
        {"preset": "ch6", "service": s}
        for s in (
            {"law": "gamma", "mean_ms": [10, 30], "shape": 0.5},
            {"law": "gamma", "mean_ms": 30, "shape": 2.5},
            {"law": "lognormal", "mean_ms": [10, 30], "sigma": 0.5},
            {"law": "deterministic", "mean_ms": 10},
            {"law": "trace", "delays_ms": [1, 200, 33]},
            {"law": "exponential", "mean_ms": 0.0},
        )
    ),
]


@pytest.mark.parametrize("section", CHANNELS, ids=str)
def test_kernel_and_link_decide_alike(section: dict) -> None:
    pytest.importorskip("numba")
    config = channel_from_mapping(section)
    for period in (None, 33.3):
        links = simulate(config, 2, 10, 7, engine="python", frame_period_ms=period)
        kernel = simulate(config, 2, 10, 7, engine="kernel", frame_period_ms=period)
        for a, b in zip(links.runs, kernel.runs):
            assert len(a.offered_ns) > 50
            same(a, b)


@pytest.mark.parametrize("engine", ["python", "kernel"])
@pytest.mark.parametrize("preset", ["ch5", "ch6"])
def test_adding_and_renaming_cameras_changes_nothing_for_the_others(engine: str, preset: str) -> None:
    if engine == "kernel":
        pytest.importorskip("numba")
    config = channel_from_mapping({"preset": preset})
    few = simulate(config, ["b", "d"], 20, 3, engine=engine)
    many = simulate(config, ["a", "b", "c", "d"], 20, 3, engine=engine)
    same(few.runs[0], many.runs[1])
    same(few.runs[1], many.runs[3])
    assert not np.array_equal(many.runs[0].due_ns[:50], many.runs[1].due_ns[:50])
    other = simulate(config, ["b", "d"], 20, 4, engine=engine)
    assert not np.array_equal(few.runs[0].started_ns[:50], other.runs[0].started_ns[:50])


def test_counts_close() -> None:
    chance = {"probability": 0.1}
    faults = {"loss": chance, "duplication": chance, "reset": {"mean_interval_ms": 500}}
    result = simulate(channel_from_mapping({"preset": "ch6", "faults": faults}), 3, 30).summary()
    assert result["engine"] == "python"
    assert result["offered"] == sum(result[name] for name in OUTCOMES)
    assert min(result[k] for k in ("lost", "broken", "superseded", "delivered", "duplicated")) > 0


def test_known_figures_of_the_presets() -> None:
    """Facts measured independently: ch5 ages 121 ms on average; ch6 at 30 ms period 94.5 at-start, 84.0
    modulated, under drop-new."""
    pytest.importorskip("numba")

    def age(**section: object) -> float:
        return simulate(channel_from_mapping(section), 18, 600, 1).summary()["mean_age_ms"]

    periodic = {"process": "periodic", "period_ms": 30.0}
    assert age(preset="ch5") == pytest.approx(121.2, abs=0.5)
    assert age(preset="ch5", discipline="parallel") == pytest.approx(54, abs=0.5)
    chain = {"preset": "ch6", "arrivals": periodic, "discipline": "drop-new"}
    assert age(**chain, service_state="at-start") == pytest.approx(94.5, abs=0.7)
    assert age(**chain, service_state="modulated") == pytest.approx(84.0, abs=0.7)


def test_replayed_offers_are_decided_as_in_the_simulation() -> None:
    config = channel_from_mapping({"preset": "ch6", "faults": {"loss": {"probability": 0.2}}})
    run = simulate(config, ["x"], 30, 9, engine="python", frame_period_ms=33.3).runs[0]
    offers = {"x": [(int(t), 20_000) for t in run.offered_ns]}
    transits = offer_all(Channel(config, 9), offers, run.end_ns)[1]["x"]
    assert [OUTCOMES.index(t.outcome or "in_flight") for t in transits] == run.outcome.tolist()
    assert [t.due_ns or -1 for t in transits] == run.due_ns.tolist()


@pytest.mark.parametrize("section", [{"preset": "ch5"}, {"preset": "ch6", "chain": {"scope": "per-camera"}}], ids=str)
def test_the_number_of_threads_changes_nothing(section: dict) -> None:
    pytest.importorskip("numba")
    config = channel_from_mapping(section)
    alone, many = (simulate(config, 5, 60, 3, engine="kernel", threads=n) for n in (1, 4))
    for a, b in zip(alone.runs, many.runs):
        same(a, b)
        assert (a.due_ns == b.due_ns).all() and a.state_share == b.state_share
    assert alone.summary() == many.summary()


def test_cameras_that_take_turns_are_spread_over_the_period() -> None:
    config = channel_from_mapping({"preset": "ch5", "arrivals": {"spread": True}})
    runs = simulate(config, ["c", "a", "b"], 1, engine="python").runs
    assert [int(run.offered_ns[0]) for run in runs] == [20 * 10**6, 0, 10 * 10**6]


@pytest.mark.parametrize("discipline", ["newest-waits", "parallel"])
def test_omega_is_what_a_buffer_would_hold(discipline: str) -> None:
    """The edge's own buffer, fed with what arrived, at instants on deliveries and between them, before the
    first and after the last. Parallel frames overtake each other."""
    result = simulate(channel_from_mapping({"preset": "ch6", "discipline": discipline}), 3, 20, 11)
    rng = np.random.default_rng(0)
    due = np.concatenate([run.due_ns[run.outcome == 1] for run in result.runs])
    at = np.concatenate([[0], rng.integers(0, 20 * 10**9, 200), rng.choice(due, 100), [20 * 10**9]])
    found = result.omega(at)
    assert found.shape == (302, 3) and found.dtype == np.int64
    buffer = FrameBuffer([run.camera for run in result.runs])
    deliveries = sorted(
        (int(run.due_ns[n]), run.camera, int(n), int(run.offered_ns[n]))
        for run in result.runs
        for n in np.flatnonzero(run.outcome == 1)
    )
    for row in np.argsort(at):
        while deliveries and deliveries[0][0] <= at[row]:
            due_ns, camera, number, born_ns = deliveries.pop(0)
            buffer.put(frame_of(camera, "s", number, born_ns), due_ns)
        held = buffer.newest()
        assert [held[c].generated_ns if c in held else -1 for c in buffer.cameras] == found[row].tolist()
    assert (found[0] == -1).all() and (found[-1] > 0).all()
    np.testing.assert_array_equal(result.ages_ms(at), np.where(found < 0, np.nan, (at[:, None] - found) / 1e6))


def test_without_numba_the_links_themselves_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numba", None)  # what import finds where it is not installed
    config = channel_from_mapping({"preset": "ch5"})
    assert simulate(config, 1, 1).engine == "python"
    with pytest.raises(SimulationError, match="numba is not installed"):
        simulate(config, 1, 1, engine="kernel")


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"cameras": 0}, "cameras"),
        ({"seconds": 0}, "seconds"),
        ({"engine": "gpu"}, "engine"),
        ({"engine": "kernel"}, "python engine only"),
    ],
)
def test_impossible_requests_are_refused(more: dict, why: str) -> None:
    config = channel_from_mapping({"faults": {"duplication": {"probability": 0.5}}})
    with pytest.raises(SimulationError, match=why):
        simulate(config, **{"cameras": 1, "seconds": 1, **more})
