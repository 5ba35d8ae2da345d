from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
import yaml

from channel_emu.model.settings import channel_from_mapping


def read(text: str, folder: Path = Path()):
    return channel_from_mapping(yaml.safe_load(text), "room.yaml: channel", folder)


def test_presets_hold_the_thesis_numbers() -> None:
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


@pytest.mark.parametrize(
    ("short", "long"),
    [
        ("{arrivals: 'periodic:30ms'}", "{arrivals: {process: periodic, period_ms: 30}}"),
        ("{preset: ch5, arrivals: periodic}", "{preset: ch5}"),
        (
            "{arrivals: mmpp, chain: 'mu1=1/30,mu2=1/30'}",
            "{preset: ch6, service: none, discipline: drop-new, chain: {states: []}}",
        ),
        # Keys beside a preset override it; another law replaces the preset's whole.
        ("{preset: ch5, service: {mean_ms: 90}}", "{preset: ch5, service: 'exp:90ms'}"),
        ("{preset: ch5, service: 'gamma:5ms:2'}", "{preset: ch5, service: {law: gamma, mean_ms: 5, shape: 2}}"),
        ("{preset: ch6, service: 'exp:30ms,exp:60ms', chain: {scope: shared}}", "{preset: ch6}"),
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
    ],
)
def test_the_short_notation_stands_for_sections(tmp_path: Path, short: str, long: str) -> None:
    """Files are relative to the given folder; the preset's name alone may differ. Reading what was written gives the
    same."""
    (tmp_path / "delays.csv").write_text("# a link\ntime_s, delay_ms\n0.1,1.5\n0.2,20\n0.3,3\n")
    found, expected = (read(text, tmp_path) for text in (short, long))
    assert msgspec.structs.replace(found, preset=None) == msgspec.structs.replace(expected, preset=None)
    assert msgspec.structs.replace(channel_from_mapping(found.to_mapping()), preset=found.preset) == found


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{delay_ms: 5}", "channel.delay_ms: unknown key"),
        ("{service: {law: exponential, mean_ms: -1}}", "service.mean_ms: expected a number, at least 0"),
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
        ("{faults: [loss]}", "channel.faults: expected a mapping"),
    ],
)
def test_one_line_names_the_key_and_what_was_expected(text: str, expected: str) -> None:
    with pytest.raises(ValueError) as refused:
        read(text)
    assert str(refused.value).startswith("room.yaml: channel") and expected in str(refused.value)
    assert "\n" not in str(refused.value)
