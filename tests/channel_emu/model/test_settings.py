"""Channels in words: sections and the short notation, and tables of delays as loggers write them."""

from pathlib import Path

import msgspec
import pytest
import yaml

from channel_emu.estimate.recording import read_recording
from channel_emu.model.settings import channel_from_mapping
from channel_emu.model.table import TableError, read_delays
from tests.support import refused


def read(text: str, folder: Path = Path()):
    return channel_from_mapping(yaml.safe_load(text), "room.yaml: channel", folder)


def test_presets_hold_the_thesis_numbers():
    ch5, ch6 = read("preset: ch5"), read("preset: ch6")
    assert (ch5.arrivals.period_ms, ch5.service.law, ch5.service.mean_ms) == (30.0, "exponential", 60.0)
    assert ch5.discipline == "drop-new" and ch5.chain is None
    assert ch6.chain is not None and ch6.chain.scope == "shared" and ch6.state_names == ["low", "high"]
    assert ch6.chain.mu1_per_ms == ch6.chain.mu2_per_ms == pytest.approx(1 / 30)
    assert ch6.arrivals.rate_per_ms == pytest.approx([1 / 120, 1 / 30])
    assert ch6.service.mean_ms == [30.0, 60.0]
    assert (ch6.service_state, ch6.discipline) == ("at-start", "newest-waits")
    high, low, slow = read("preset: ch6-high"), read("preset: ch6-low"), read("preset: ch6-slow")
    assert (high.arrivals.rate_per_ms, high.service.mean_ms) == (pytest.approx(1 / 60), 60.0)
    assert (low.arrivals.rate_per_ms, low.service.mean_ms) == (pytest.approx(1 / 120), 30.0)
    assert slow.chain is not None and slow.chain.mu1_per_ms == pytest.approx(1 / 3000)
    ideal = read("{}")
    assert (ideal.preset, ideal.service.law, ideal.arrivals.process) == ("ideal", "none", "as-offered")


def test_the_short_notation_stands_for_sections(tmp_path):
    """Files are relative to the given folder; the preset's name alone may differ. Reading what was written gives the
    same."""
    for short, long in (
        ("{arrivals: 'periodic:30ms'}", "{arrivals: {process: periodic, period_ms: 30}}"),
        # Keys beside a preset override it; another law replaces the preset's whole.
        ("{preset: ch5, service: {mean_ms: 90}}", "{preset: ch5, service: 'exp:90ms'}"),
        ("{preset: ch5, service: 'gamma:5ms:2'}", "{preset: ch5, service: {law: gamma, mean_ms: 5, shape: 2}}"),
        (
            "{preset: ch6, chain: {generator_per_ms: [[-1, 1], [2, -2]]}}",
            "{arrivals: mmpp, service: 'exp:30ms,exp:60ms', discipline: newest-waits, "
            "chain: {generator_per_ms: [[-1, 1], [2, -2]]}}",
        ),
        ("{service: 'trace:delays.csv'}", "{service: {law: trace, delays_ms: [1.5, 20, 3]}}"),
        ("{faults: {loss: 0.2, reset: 5000}}", "{faults: {loss: {probability: 0.2}, reset: {mean_interval_ms: 5000}}}"),
        (
            "{preset: gilbert-elliott, faults: {corruption: 0.1}}",
            "{preset: gilbert-elliott, faults: {loss: [0.01, 0.5], corruption: {probability: 0.1}}}",
        ),
    ):
        (tmp_path / "delays.csv").write_text("# a link\ntime_s, delay_ms\n0.1,1.5\n0.2,20\n0.3,3\n")
        found, expected = (read(text, tmp_path) for text in (short, long))
        assert msgspec.structs.replace(found, preset=None) == msgspec.structs.replace(expected, preset=None)
        assert msgspec.structs.replace(channel_from_mapping(found.to_mapping()), preset=found.preset) == found


def test_one_line_names_the_key_and_what_was_expected():
    for text, expected in (
        ("{delay_ms: 5}", "channel.delay_ms: unknown key"),
        ("{service: {law: exponential, mean_ms: 1, shape: 2}}", "shape: belongs to law gamma only"),
        ("{service: {law: exponential, mean_ms: [1, 2]}}", "there is no chain"),
        ("{chain: {mu1_per_ms: 1}}", "expected mu1_per_ms and mu2_per_ms, or generator_per_ms"),
        ("{chain: {mu1_per_ms: 0, mu2_per_ms: 0}}", "initial: the chain ends in different states"),
        ("{chain: {generator_per_ms: [[-1, 2], [1, -1]]}}", "rows sum to zero"),
        ("{chain: {mu1_per_ms: 1, mu2_per_ms: 1, initial: up}}", "initial: expected one of s1, s2"),
        ("{faults: {rain: {}}}", "channel.faults.rain: fault 'rain' is not known; there are: loss"),
        ("{faults: {loss: [0.1, 0.2]}}", "channel: faults.loss.probability: expected one number or one a state"),
        ("{chain: 'mu3=1'}", "channel.chain: 'mu3=1': expected mu1="),
        ("{faults: {blackout: {windows_ms: [[5, 3]]}}}", "channel.faults.blackout: windows_ms"),
    ):
        said = str(refused(ValueError, "", read, text))
        assert said.startswith("room.yaml: channel") and expected in said


def test_delays_are_read_by_the_header(tmp_path):
    for text in (
        "\ufeff# a logger\n\n20\n21.5\n30\n",
        "delay_ms,seq\r\n20,0\r\n21.5,1\r\n30,2\r\n",
        "seq;Delay [ms];note\n0;20,0;a\n1;21,5;b\n2;30;c,d\n",
        "seq;Delay [s]\n0;0,020\n1;0,0215\n2;3,000e-2\n",
        "seq\tlatency (s)\n0\t0.02\n1\t0.0215\n2\t3e-2\n",
        "# seq delay_us\n0 20000\n1 21500\n2 30000\n",
        "One-way delay / s\n0,02\n0,0215\n0,03\n",
        "delay_ms,lost\n20,no\nNaN,yes\n21.5,no\n,no\n30,no\n",
    ):
        (tmp_path / "delays").write_text(text)
        assert read_delays(tmp_path / "delays") == pytest.approx([20.0, 21.5, 30.0])


def test_what_can_be_read_in_two_ways_or_none_is_refused(tmp_path):
    for text, message in (
        ("0,20\n1,21\n", "expected one delay in ms a line, with a decimal point, or a header"),
        ("seq,rtt_ms\n0,20\n", r"expected a column delay_ms .* it has seq, rtt_ms"),
        ("delay [furlongs]\n20\n", "has no unit that is known: call it delay_ms"),
        ("delay_ms,delay_s\n20,1\n", "two columns are called delay"),
        ("seq,delay_ms\n0,20,5\n", "line 2 has 3 fields, expected 2: decimal commas need semicolons"),
        ("seq;delay_ms\n0;1,5\n1;1.5\n", "decimal points and with commas"),
        ("seq;delay_us\n0;1,500\n1;12,500\n2;900\n", "1,500 may be thousands or have three decimals: write decimal"),
        ("delay_ms\n20\n\nslow\n", "line 4: delay_ms is 'slow', expected a number"),
        ("delay_ms,lost\n20,perhaps\n", "line 2: lost is 'perhaps', expected 0 or 1"),
        ("", "holds no delay"),
    ):
        (tmp_path / "delays").write_text(text)
        refused(TableError, message, read_delays, tmp_path / "delays")


def test_recordings_are_read_by_the_header(tmp_path):
    for text in (
        "seq;offered_s;delivered_s;camera\n0;0,0;0,0415;a\n1;0,033;;a\n",
        "sent [s],received [s],camera\n1764285533.125,1764285533.1665,a\n1764285533.158,,a\n",
        "send_time_ns,delay_ms,camera\n1764285533125000192,41.5,a\n1764285533158000128,,a\n",
        "offered_ms,delay_ms,lost,camera\n0,41.5,0,a\n33,0,1,a\n",
    ):
        (tmp_path / "rows.csv").write_text(text)
        (camera,) = read_recording(tmp_path / "rows.csv").cameras
        assert camera.name == "a" and camera.offered_ms == pytest.approx([0.0, 33.0])
        assert camera.delay_ms[0] == pytest.approx(41.5) and camera.delivered().tolist() == [True, False]
