import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import grpc
import pytest

from channel_emu.cli import main
from channel_emu.model import notation
from freshfield import ledger
from tests.channel_emu.test_testing import HELLO, Greeter
from tests.support import free_port, refusal, wait_until


def simulate(capsys, line: str, *words: str) -> dict:
    """The result of the options in a line, and of words that have spaces."""
    assert main(["simulate", "--json", *line.split(), *words]) == 0
    return json.loads(capsys.readouterr().out)


def test_simulate_takes_the_short_notation(capsys):
    rest = "--service-state modulated --discipline drop-new --cameras 3 --seconds 120 --seed 4"
    spelled = "--arrivals periodic:30ms --service exp:30ms,exp:60ms --chain mu1=1/30,mu2=1/30"
    found = simulate(capsys, f"{spelled} {rest}")
    assert found["mean_age_ms"] == pytest.approx(84, abs=4)
    assert found["offered"] == found["delivered"] + found["dropped"] + found["in_flight"]
    again = simulate(capsys, f"--preset ch6 --arrivals periodic:30 {rest}")
    assert again["mean_age_ms"] == found["mean_age_ms"]  # the same channel in other words


def test_the_frames_of_a_simulation_can_be_fitted(capsys, tmp_path):
    frames = tmp_path / "new" / "frames.csv"
    line = f"--preset ch5 --seconds 60 --csv {frames} --fault loss:0.1 --fault corruption:0.25 --fault"
    found = simulate(capsys, line, "duplication:{probability: 0.5}")
    shares = [found[key] / found["delivered"] for key in ("duplicated", "corrupted")]
    assert shares == pytest.approx([0.5, 0.25], rel=0.2)
    lines = frames.read_text().splitlines()
    assert lines[0] == "offered_ms,delivered_ms,camera,outcome" and len(lines) == found["offered"] + 1
    assert sum(row.endswith(",lost") for row in lines) == found["lost"] > 0
    assert main(["fit", str(frames), "--states", "1", "--json"]) == 0
    fitted = json.loads(capsys.readouterr().out)
    assert fitted["delays"] == found["delivered"]
    assert fitted["parameters"]["mean_ms"]["low"] < 60 < fitted["parameters"]["mean_ms"]["high"]


def test_spans_and_rates():
    for text, value in (("30ms", 30), ("3s", 3000), ("250us", 0.25), ("7", 7), ("1.5min", 90_000)):
        assert notation.span_ms(text) == pytest.approx(value)
    for text, value in (("1/30ms", 1 / 30), ("1/30", 1 / 30), ("0.5/ms", 0.5), ("33/s", 0.033), ("2/1s", 0.002)):
        assert notation.rate_per_ms(text) == pytest.approx(value)


def test_mistakes_get_one_line(capsys):
    for words, why in (
        (["--arrivals", "sometimes"], "expected as-offered, periodic:30ms"),
        (["--arrivals", "poisson:1/"], "is not a rate"),
        (["--chain", "{generator_per_ms: [[-1, 1], [2, -2]]}"], "more states: a scenario's `chain:`"),
        (["--service", "exp:30ms,det:60ms"], "expected one distribution"),
        (["--service", "trace:/no/such/file"], "cannot be read"),
        (["--frame-bytes", "9" * 400], "frame_bytes: expected 0 to"),
        (["--fault", "bandwidth:" + "9" * 400], "bandwidth.megabits_per_s: expected a number"),
        (["--fault", "blackout:{windows_ms: [[0, 9]], cameras: [cam01]}"], "'cam01' is none of the 1 simulated"),
    ):
        said = refusal(capsys, main, "simulate", *words)
        assert why in said and said.startswith("channel-emu: ")
    again = ["--to", "x:1", "--trace", "t.jsonl", "--replay", "./t.jsonl"]
    assert "would overwrite what --replay reads" in refusal(capsys, main, "proxy", *again)


@contextmanager
def command(*words: object) -> Iterator[subprocess.Popen[str]]:
    """A command in a process of its own."""
    line = [sys.executable, "-m", "channel_emu.cli", *map(str, words)]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def ended(process: subprocess.Popen[str]) -> str:
    """What it printed by the time SIGTERM had ended it in order."""
    process.send_signal(signal.SIGTERM)
    out, log = process.communicate(timeout=20)
    assert process.returncode == 0, log
    return out


def test_run_as_a_process_ends_cleanly_when_told(tmp_path):
    out, port = tmp_path / "out", free_port()
    words = ["run", "card", "--listen", f"127.0.0.1:{port}", "--to", f"127.0.0.1:{free_port()}"]
    words += ["--out", str(out), "--trace", str(out / "t.jsonl")]
    with command(*words) as process:
        wait_until((out / "channel.json").exists, "no status", 30.0)
        # A second emulator on the port is told so.
        with command("proxy", "--to", "x:1", "--listen", f"127.0.0.1:{port}") as second:
            assert "cannot listen on" in second.communicate(timeout=30)[1] and second.returncode == 2
        ended(process)
    assert json.loads((out / "channel.json").read_text())["running"] is False
    assert any(file.closed and file.role == "emulator" for file in ledger.read_all(out))


def test_proxy_puts_a_service_behind_a_link_until_told():
    greeter, listen = Greeter(), f"127.0.0.1:{free_port()}"
    options = ("--service", "det:30ms", "--direction", "both", "--seed", 2)
    with command("proxy", "--to", greeter.address, "--json", "--listen", listen, *options) as process:
        with grpc.insecure_channel(listen) as channel:
            hello = channel.unary_unary(HELLO)
            assert hello(b"you", wait_for_ready=True, timeout=30) == b"hello you from nobody"
        found = json.loads(ended(process))
    greeter.stop()
    assert set(found["by_method"]) == {f"up {HELLO}", f"down {HELLO}"} and found["seed"] == 2
    assert found["delivered"] == found["offered"] == 2 and found["delay_ms"]["mean"] == 30
