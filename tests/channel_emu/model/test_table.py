"""Tables of delays as loggers write them: read as they say, or refused in one sentence."""

from __future__ import annotations

import pytest

from channel_emu.estimate.recording import read_recording
from channel_emu.model.notation import NotationError, delays_ms


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff# a logger\n\n20\n21.5\n30\n",
        "delay_ms,seq\r\n20,0\r\n21.5,1\r\n30,2\r\n",
        "seq;Delay [ms];note\n0;20,0;a\n1;21,5;b\n2;30;c,d\n",
        "seq;Delay [s]\n0;0,020\n1;0,0215\n2;3,000e-2\n",
        "seq\tlatency (s)\n0\t0.02\n1\t0.0215\n2\t3e-2\n",
        "# seq delay_us\n0 20000\n1 21500\n2 30000\n",
        "One-way delay / s\n0,02\n0,0215\n0,03\n",
        "delay_ms,lost\n20,no\nNaN,yes\n21.5,no\n,no\n30,no\n",
        "owd_ns\n20000000\n21500000\n30000000\n",
    ],
)
def test_delays_are_read_by_the_header(tmp_path, text):
    (tmp_path / "delays").write_text(text)
    assert delays_ms(tmp_path / "delays") == pytest.approx([20.0, 21.5, 30.0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
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
        "seq;offered_s;delivered_s;camera\n0;0,0;0,0415;a\n1;0,033;;a\n",
        "sent [s],received [s],camera\n1764285533.125,1764285533.1665,a\n1764285533.158,,a\n",
        "send_time_ns,delay_ms,camera\n1764285533125000192,41.5,a\n1764285533158000128,,a\n",
        "offered_ms,delay_ms,lost,camera\n0,41.5,0,a\n33,0,1,a\n",
    ],
)
def test_recordings_are_read_by_the_header(tmp_path, text):
    (tmp_path / "rows.csv").write_text(text)
    (camera,) = read_recording(tmp_path / "rows.csv").cameras
    assert camera.name == "a" and camera.offered_ms == pytest.approx([0.0, 33.0])
    assert camera.delay_ms[0] == pytest.approx(41.5) and camera.delivered().tolist() == [True, False]
