"""Tables of delays: read as they say, or refused in one sentence."""

from __future__ import annotations

import pytest

from channel_emu.estimate.recording import read_recording
from channel_emu.model.notation import NotationError, delays_ms
from tests.conftest import case_dir


@pytest.mark.parametrize(
    "text",
    [
        "20\n21.5\n30\n",
        "\ufeff# a logger\n\n20\n21.5\n30\n",
        "delay_ms\n20\n21.5\n30\n",
        "delay_ms,seq\r\n20,0\r\n21.5,1\r\n30,2\r\n",
        'seq,"delay_ms",lost\n1,20,0\n2,0,1\n3,21.5,0\n4,,0\n5, 3e1\n',
    ],
)
def test_delays_are_read_by_the_header(tmp_path, text):
    (tmp_path / "delays").write_text(text)
    assert delays_ms(tmp_path / "delays") == [20.0, 21.5, 30.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0,20\n1,21\n", "line 1 has 2 fields, expected 1: write decimal points"),
        ("0 20\n1 21\n", "expected one delay in ms a line, or a column delay_ms; it has 0 20"),
        ("seq,rtt_ms\n0,20\n", "expected one delay in ms a line, or a column delay_ms; it has seq, rtt_ms"),
        ("seq;delay_ms\n0;20\n", "it has seq;delay_ms"),
        ("seq,delay_ms\n0,20,5\n", "line 2 has 3 fields, expected 2"),
        ("delay_ms\n20\n\nslow\n", "line 4: delay_ms is 'slow', expected a number with a decimal point"),
        ("20\nnan\n", "line 2: delay_ms is 'nan', expected a number"),
        ("20\n1e999\n", "line 2: delay_ms is '1e999', expected a number"),
        ("delay_ms,lost\n20,perhaps\n", "line 2: lost is 'perhaps', expected 0 or 1"),
        ("delay_ms,lost\n0,1\n", "holds no delay"),
        ("", "holds no delay"),
    ],
)
def test_what_can_be_read_in_two_ways_or_none_is_refused(tmp_path, text, message):
    (tmp_path / "delays").write_text(text)
    with pytest.raises(NotationError, match=message) as error:
        delays_ms(tmp_path / "delays")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "text",
    [
        "camera,delivered_ms,offered_ms\na,41.5,0\na,,33\n",
        "offered_ms,delay_ms,lost,camera\n0,41.5,0,a\n33,0,1,a\n",
        "offered_ms,delivered_ms,camera\n1764285533125,1764285533166.5,a\n1764285533158,,a\n",
    ],
)
def test_recordings_are_read_by_the_header(tmp_path, text):
    (tmp_path / "rows.csv").write_text(text)
    (camera,) = read_recording(tmp_path / "rows.csv").cameras
    assert camera.name == "a" and camera.offered_ms == pytest.approx([0.0, 33.0])
    assert camera.delay_ms[0] == pytest.approx(41.5) and camera.delivered().tolist() == [True, False]


def test_reported_traces():
    folder = case_dir("10-delay-trace-columns")
    for name in ("seq-delay.csv", "comma.txt"):
        with pytest.raises(NotationError, match="line 1 has 2 fields, expected 1"):
            delays_ms(folder / name)
    assert delays_ms(folder / "lost.csv") == [20.0, 22.0]
