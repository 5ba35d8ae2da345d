"""A deployment in virtual time: repeatable bit for bit, books that close, time charged as said."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from channel_emu.model.link import EventKind
from channel_emu.model.settings import channel_from_mapping
from channel_emu.virtual.simulate import simulate
from edge_server.experiments.virtual.from_scenario import build_deployment
from edge_server.experiments.virtual.run_settings import RunSettings
from edge_server.experiments.virtual.simulate import digest
from edge_server.experiments.virtual.virtual_deployment import VirtualDeployment
from edge_server.settings import ComputeConfig
from freshfield.frame import to_request
from freshfield.scenario import Scenario, parse
from tests.edge_server.experiments.rollouts.small import RAW
from tests.edge_server.experiments.sets import SMALL
from tests.support import small_world

SETTINGS = RunSettings(steps=2, compute=ComputeConfig(ms_per_step=40.0, ms_per_update=20.0))


def scenario(channel: dict[str, Any] | None = None, seed: int = 3, **other: Any) -> Scenario:
    over = RAW["channel"] if channel is None else channel
    data = {
        **RAW,
        "seed": seed,
        "source": small_world(),
        "channel": over,
        "edge": {"field": "ngp", "field_options": SMALL},
    }
    return parse({**data, **other}, Path("virtual.yaml"))


def run(what: Scenario, settings: RunSettings = SETTINGS, seconds: float = 1.0) -> VirtualDeployment:
    deployment = build_deployment(what, settings)
    deployment.run(seconds)
    return deployment


def closes(frames: dict[str, Any]) -> bool:
    ends = ("skipped", "dropped_busy", "superseded", "lost", "broken", "delivered", "in_flight")
    out = sum(frames[name] for name in ends) + sum(frames["rejected"].values())
    sent = frames["captured"] - frames["replaced"] - frames["waiting"]
    return sent == frames["sent"] and frames["sent"] + frames["duplicated"] == out


_SHARES = {kind: {"probability": share} for kind, share in (("loss", 0.1), ("corruption", 0.2), ("duplication", 0.2))}
FAULTS = {"preset": "ch6", "faults": {**_SHARES, "reset": {"at_ms": [400.0]}, "bandwidth": {"megabits_per_s": 2.0}}}


@pytest.mark.parametrize("channel", [{"preset": "ch5"}, FAULTS], ids=["ch5", "faults"])
def test_one_seed_gives_the_same_run_bit_for_bit(channel):
    first, second = (run(scenario(channel)) for _ in range(2))
    assert first.publications and first.publications == second.publications
    assert first.frames() == second.frames()
    a, b = (d.updates.field.state() for d in (first, second))
    assert a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)
    other = run(scenario(channel, seed=4))
    assert [p.ages_ms for p in other.publications] != [p.ages_ms for p in first.publications]
    assert digest(first) == digest(second) != digest(other)


def test_the_books_close_with_every_fault_and_damage_is_refused():
    deployment = run(scenario(FAULTS), seconds=2.0)
    frames = deployment.frames()
    assert closes(frames), frames
    assert frames["rejected"]["crc_mismatch"] > 0 and frames["rejected"]["replayed_sequence"] > 0
    assert frames["lost"] > 0 and frames["broken"] > 0 and frames["skipped"] > 0


@pytest.mark.parametrize("every", [1, 5])
def test_depth_is_in_one_of_so_many_frames_and_takes_its_time_on_the_line(every):
    rate, sensors = {"preset": "ideal", "faults": {"bandwidth": 1.0}}, {"depth_sensor": {}}
    seen: dict[int, bool] = {}
    deployment = build_deployment(scenario(rate, source=small_world(depth_every=every, effects=sensors)), SETTINGS)
    for _ in range(12):
        deployment.run(1 / 15)
        for item in deployment.updates.buffer.newest().values():
            took_ns = item.received_ns - item.generated_ns
            assert took_ns == pytest.approx(8000 * to_request(item).ByteSize(), abs=1)
            seen[item.sequence] = item.depth is not None
    expected = {1: set(seen), 5: {0, 5, 10}}[every]
    assert len(seen) > 8 and {sequence for sequence in seen if seen[sequence]} == expected & set(seen)


@pytest.mark.parametrize(
    "channel",
    [{"preset": "ch5"}, {"preset": "ch5", "discipline": "newest-waits", "server": {"shared": True}}],
    ids=["own lines", "one line"],
)
def test_the_links_decide_as_the_simulation_does(channel):
    what = scenario(channel)
    deployment = run(what, RunSettings(steps=1, compute=ComputeConfig(ms_per_update=500.0)), seconds=2.0)
    config = channel_from_mapping(what.channel)
    alone = simulate(config, list(what.training), 2.0, what.seed, frame_period_ms=1e3 / 15)
    expected = {r.camera: r.link.counts[EventKind.DELIVERED] for r in alone.runs}
    assert dict(deployment.delivered) == expected


def test_the_present_is_when_the_charge_is_over():
    deployment = run(scenario())
    assert {p.update_ms for p in deployment.publications} == {100.0}
    ends = [p.published_ns for p in deployment.publications]
    assert {b - a for a, b in pairwise(ends)} == {100_000_000}, "the next update starts at once"
    assert all(p.psnr_db is not None and p.truth_gap_ms == 0.0 for p in deployment.publications)


def test_free_compute_publishes_at_the_decision_and_never_spins():
    free = run(scenario({}), RunSettings(steps=1, compute=ComputeConfig()), seconds=0.5)
    assert {p.update_ms for p in free.publications} == {0.0}
    assert len(free.publications) == 8, "once an arrival instant: ticks 0 to 7 of 15 a second"
    epochs = run(scenario({}), RunSettings(steps=1, epoch_ms=200.0), seconds=1.0)
    times = [p.published_ns for p in epochs.publications]
    assert np.diff(times).tolist() == [200_000_000] * (len(times) - 1)


@pytest.mark.slow
def test_at_twice_the_load_frames_are_left_out_and_what_is_shown_does_not_age() -> None:
    """A processor that takes in less than 100 frames a second; sixty of them, and twice as many."""
    options = {"layers": True, "gaussians": 300, "start": 200, "seed_cells": 12, "threads": 1}
    edge = {"field": "splat", "field_options": options, "policy": {"name": "all"}, "updates": "arrivals"}
    settings = RunSettings(
        steps=1, compute=ComputeConfig(ms_per_update=5.0, ms_per_view=10.0), epoch_ms=40.0, score_every_ms=None
    )
    ages = []
    for fps in (15.0, 30.0):
        deployment = run(scenario({}, edge=edge, source=small_world(fps=fps)), settings, seconds=6.0)
        late = [p for p in deployment.publications if p.t_s > 2.0]
        assert max(p.update_ms for p in late) <= 80.0
        halves = [np.mean([p.aaoi_ms for p in late if (p.t_s > 4.0) is second]) for second in (False, True)]
        assert halves[1] < 1.1 * halves[0]
        ages.append(np.mean(halves))
        assert closes(deployment.frames())
    assert deployment.updates.buffer.shed > 0.1 * deployment.updates.buffer.arrivals
    assert ages[1] < 2.0 * ages[0]


def test_a_camera_that_reports_late_is_waited_for_only_as_long_as_the_grace():
    channel = {"service": {"law": "deterministic", "mean_ms": 700.0}}
    settings = RunSettings(steps=1, grace_ms=0.0)
    deployment = run(scenario(channel), settings, seconds=1.5)
    assert deployment.publications[0].published_ns == 700_000_000


def test_what_is_shown_is_the_newest_publication_carried_on_to_seeded_instants() -> None:
    settings = RunSettings(steps=2, compute=ComputeConfig(ms_per_step=40.0, ms_per_update=20.0), shown_every_ms=70.0)
    deployment = build_deployment(scenario(), settings)
    asked: list[tuple[int, int]] = []
    take = deployment.updates.field.snapshot

    class Watched:
        def __init__(self, snapshot: Any, published_ns: int) -> None:
            self._snapshot, self._published_ns = snapshot, published_ns

        def at(self, present_ns: int) -> Any:
            asked.append((self._published_ns, present_ns))
            return self._snapshot.at(present_ns)

    def snapshot(present_ns: int | None = None) -> Any:
        return Watched(take(present_ns), present_ns or 0)

    deployment.updates.field.snapshot = snapshot  # type: ignore[method-assign, assignment]
    deployment.settings = replace(settings, score_every_ms=None)
    published = [p.published_ns for p in deployment.run(1.5)]
    assert len(asked) == len(deployment.shown) > 5
    for newest_ns, at_ns in asked:
        assert newest_ns == max(p for p in published if p <= at_ns)
    assert [s.published_ns for s in deployment.shown] == [at for _, at in asked]
    periods = {s.published_ns // 70_000_000 for s in deployment.shown}
    assert len(periods) == len(deployment.shown), "one in each period"
