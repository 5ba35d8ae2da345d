from pathlib import Path

import msgspec
import pytest

from channel_emu.live.replay_link import ReplayLink
from channel_emu.model import trace
from channel_emu.model.channel import Channel
from channel_emu.model.link import Event, EventKind
from channel_emu.model.settings import channel_from_mapping
from channel_emu.model.trace import TraceError, TraceWriter
from tests.support import refused

MS = 10**6
CHANCE = {"probability": 0.15}
FAULTS = {"loss": CHANCE, "corruption": CHANCE, "duplication": CHANCE, "reset": {"mean_interval_ms": 2000.0}}


def record(path: Path, section: dict, frames: int) -> tuple[trace.Trace, dict[str, list[Event]]]:
    """Two cameras' frames through fresh links, written as the live emulator does; the events by camera."""
    config = channel_from_mapping(section)
    writer, channel = TraceWriter(path, config, 3), Channel(config, 3)
    refused(TraceError, "another emulator writes its trace there: name", TraceWriter, path, config, 3)
    told: dict[str, list[Event]] = {}
    for camera, phase in (("a", 0), ("b", 7)):
        link = channel.link(camera)
        events = [e for n in range(frames) for e in link.offer((33 * n + phase) * MS, n, 1000 + n)[1]]
        events += link.advance(33 * frames * MS)
        doubled = {e.transit.number for e in events if e.kind is EventKind.DUPLICATED}
        for e in events:
            if e.kind not in (EventKind.STARTED, EventKind.DUPLICATED):
                writer.write(camera, "s1", e.transit.item, e.transit, None, e.transit.number in doubled)
        for transit in link.pending():
            writer.write(camera, "s1", transit.item, transit)
        told[camera] = events
    writer.close()
    found = trace.read(path)
    assert found.seed == 3 and msgspec.structs.replace(found.config, preset=config.preset) == config
    return found, told


@pytest.mark.parametrize("preset", ["ch5", "ch6"])
def test_a_recorded_trace_is_replayed_event_by_event_and_starts_over(tmp_path, preset):
    found, told = record(tmp_path / "t.jsonl", {"preset": preset, "faults": FAULTS}, 400)
    assert len(found.records) == 800
    for camera, records in found.by_camera().items():
        link, later_ns = ReplayLink(camera, records), 10**11
        transits, events = zip(*(link.offer(r.offered_ns, n, r.bytes) for n, r in enumerate(records)))
        events = [*(e for happened in events for e in happened), *link.advance(33 * 400 * MS)]
        assert [t.flips for t in transits] == [r.flips for r in records]
        settled = {r.number for r in records if r.outcome is not None}
        replayed, recorded = (
            sorted((e.at_ns, e.transit.number, str(e.kind)) for e in each if e.transit.number in settled)
            for each in (events, told[camera])
        )
        assert replayed == recorded
        again = [link.offer(later_ns + 40 * n * MS)[0] for n in range(400)]  # at another pace
        link.advance(10**12)
        for t, r in zip(again, records):
            assert r.number not in settled or (t.outcome, t.ended_ns - t.offered_ns) == (
                r.outcome,
                r.ended_ns - r.offered_ns,
            )
        assert link.in_flight == 0 and link.next_event_ns >= 2**62
    refused(TraceError, "cam09", ReplayLink, "cam09", [])
    *kept, _, last = records  # a killed recording has the last outcome, and not the one before
    link = ReplayLink(camera, [*kept, last])
    transits = [link.offer(r.offered_ns)[0] for r in records]
    link.advance(10**12)
    assert (transits[-2].outcome, transits[-1].arrived_ns) == ("superseded", last.arrived_ns)


def test_damaged_traces_are_refused_with_the_place(tmp_path):
    for line, old, new, why in (
        (0, '"freshfield_trace":2', '"other":2', "no trace header"),
        (0, '"freshfield_trace":2', '"freshfield_trace":1', "version 1, expected 2: record it again"),
        (0, '"seed":', '"seed":1e999, "of":', "no trace header"),
        (1, '"camera"', '"kamera"', "line 2 is not a trace record"),
        (1, '"number":', '"number":-1', r"line 2 .*`\$.number`"),
        (1, '"bytes":', '"bytes":1' + "0" * 400, r"line 2 .*`\$.bytes`"),
        (1, '"flips":[]', '"flips":[[0.5,1e999]]', "line 2 is not a trace record"),
        (1, "{", "[" * 100_000, "line 2 is not a trace record"),
    ):
        path = tmp_path / "t.jsonl"
        record(path, {"preset": "ch5"}, 20)
        lines = path.read_text().split("\n")
        assert old in lines[line]
        lines[line] = lines[line].replace(old, new, 1)
        path.write_text("\n".join(lines))
        refused(ValueError, why, trace.read, path)


def test_a_torn_last_line_is_left_out(tmp_path):
    path = tmp_path / "t.jsonl"
    found, _ = record(path, {"preset": "ch5"}, 20)
    path.write_text(path.read_text()[:-30])
    assert len(trace.read(path).records) == len(found.records) - 1
