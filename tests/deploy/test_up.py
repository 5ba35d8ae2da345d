"""The launcher with the real processes: runs that end as asked, and runs in which a process dies; that of a simulated
arm, and which processes start in which order; the folders that a run may use, since a mistyped --out must never cost
anybody a file; the line that it prints; commands at Ctrl-C and without a reader; the health check of containers."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Callable
from concurrent import futures
from pathlib import Path

import grpc
import pytest
from grpc_health.v1 import health, health_pb2, health_pb2_grpc

import freshfield as ff
from freshfield.files import read_status
from freshfield.scenario import ScenarioError, load
from freshfield_up import child_process, launcher, process_set
from freshfield_up import healthy as health_check
from freshfield_up.child_process import Child
from freshfield_up.cli import main, seconds
from freshfield_up.deployment import DeploymentError
from freshfield_up.folder import EARLIER, KEY, MARKER, FolderError, forget_earlier, prepare
from freshfield_up.process_set import ProcessSet
from freshfield_up.status import status_line, summarize
from tests.camera_node.robot.arm.simulated import own_address, require_ur_rtde
from tests.conftest import ROOT
from tests.support import alive, free_port, refusal, refused, wait_until

SMALL = """
name: small
description: the smallest thing that is still a room
seed: 3
cameras: {count: 4, held_out: [cam00]}
source: {kind: world, scene: room, width: 48, height: 48, fps: 10}
channel: {preset: ch5}
edge: {field: ngp, update_ms: 300, lpips: none}
"""
SLEEPS = "import time; time.sleep(60)"
pytestmark = pytest.mark.timeout(600)


@pytest.fixture
def asleep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., launcher.Launcher]:
    """Makes a launcher whose edge and emulator only sleep, and whose node runs the given words."""

    def make(node: str) -> launcher.Launcher:
        monkeypatch.setattr(launcher.signal, "signal", lambda *_: None)
        words = {"edge": SLEEPS, "emulator": SLEEPS, "node": node}
        made = [Child(k, f"the {k}", [sys.executable, "-c", v], tmp_path / "run" / k) for k, v in words.items()]
        processes = ProcessSet(*made, "127.0.0.1:1", "")
        monkeypatch.setattr(launcher, "process_set", lambda *_: processes)
        (tmp_path / "small.yaml").write_text(SMALL)
        run = launcher.Launcher(load(tmp_path / "small.yaml"), process_set.Options(tmp_path / "run", port=free_port()))
        run.processes = processes
        return run

    return make


def test_a_process_that_dies_ends_the_run_is_named_and_the_others_are_stopped(asleep, capfd):
    run = asleep("import os, time; print('so much'); time.sleep(0.8); os.kill(os.getpid(), 9)")
    assert run.run() == 1
    said, made = capfd.readouterr().out, run.processes
    assert "the node was killed by SIGKILL" in said and "  | so much" in said
    assert said.endswith("no report: the run did not start\n")
    assert not any(child.running for child in made.children) and made.emulator.process is None
    rows = [json.loads(line) for line in (run.options.out / "processes.jsonl").read_text().splitlines()]
    assert rows[0]["edge"]["pid"] == made.edge.pid and "machine" in rows[0]


@pytest.mark.parametrize("full", [False, True])
def test_a_recording_that_is_over_before_the_first_update_ends_the_run_well(asleep, capfd, monkeypatch, full):
    """Kernels are still being compiled. full: the disk, which costs samples and the report."""
    run = asleep("import time; time.sleep(0.5)")
    emulator, prepared = run.processes.emulator, launcher.folder.prepare

    def prepare_full(out, about):
        lock = prepared(out, about)
        for name in ("processes.jsonl", "log-report.txt"):
            (out / name).symlink_to("/dev/full")
        (out / "ledger-edge.tsv").touch()
        return lock

    if full:
        monkeypatch.setattr(launcher.folder, "prepare", prepare_full)
    monkeypatch.setattr(run, "_continue_start", lambda now_s: emulator.process or emulator.start())
    assert run.run() == full
    said = capfd.readouterr().out
    assert "the recording is over" in said and ("log-report.txt: No space left on device" in said) == full


def test_a_run_whose_lines_nobody_reads_ends_as_at_ctrl_c(asleep, monkeypatch):
    """``freshfield demo room | head -3``."""
    run = asleep(SLEEPS)
    edge, (reader, writer) = run.processes.edge, os.pipe()
    monkeypatch.setattr(edge, "start", lambda: (Child.start(edge), os.close(reader)))
    monkeypatch.setattr(sys, "stdout", os.fdopen(writer, "w"))
    assert run.run() == 0
    assert edge.process is not None and not any(child.running for child in run.processes.children)


def test_a_trouble_is_said_once_for_each_camera_whatever_its_numbers(asleep, capfd):
    (run := asleep(SLEEPS)).options.out.mkdir()
    said = [f"the depth of cam0{k} contradicts the other cameras'" for k in (2, 5)]
    for off in ("1.2 cm (median 3)", "10 cm (median 12)"):
        (run.options.out / "edge.json").write_text(json.dumps({"troubles": [*said, f"cam01: drifts {off}: look"]}))
        run._say_troubles()
    said = [*said, "cam01: drifts 1.2 cm (median 3): look"]
    assert capfd.readouterr().out.splitlines() == [f"note: {line}" for line in said]


def test_ctrl_c_ends_a_run_and_a_second_one_kills_and_one_more_ends_the_report(asleep, capfd, monkeypatch, tmp_path):
    """The second one also while the first is being obeyed; not killed, the node would end by itself."""
    monkeypatch.setattr(launcher.tuned, "GRACE_S", 120.0)
    (report := tmp_path / "report").write_text("#!/bin/sh\necho up\nsleep 60")
    report.chmod(0o700)
    monkeypatch.setattr(launcher, "program", lambda _: str(report))
    stubborn = (
        "import signal, time\nsignal.signal(signal.SIGTERM, lambda *_: print('told'))\nprint('up')\ntime.sleep(60)"
    )
    run = asleep(stubborn)
    log, out = run.processes.node.log, run.options.out

    def press() -> None:
        for file, word in ((log, "up"), (log, "told"), (out / "log-report.txt", "up")):
            wait_until(lambda f=file, word=word: f.exists() and f"\n{word}\n" in f.read_text(), f"no {file}")
            (out / "ledger-edge.tsv").touch()
            run._on_signal(signal.SIGINT, None)

    threading.Thread(target=press, daemon=True).start()
    assert run.run() == 1 and run.processes.node.killed
    assert run.failures == [f"no report (Ctrl-C); to write it: edge-server report {out}"], "all else was asked for"
    said = capfd.readouterr().out
    assert "stopping (Ctrl-C)" in said and "the node did not end in time and was killed" in said


def test_times_and_commands_are_read_and_written_as_people_write_them():
    assert [seconds(text) for text in ("60", "60s", "1.5m", "2h", "0")] == [60.0, 60.0, 90.0, 7200.0, 0.0]
    assert launcher.command_line(["/usr/bin/freshfield", "demo", "my file"]) == "freshfield demo 'my file'"
    assert launcher.command_line(["/lib/freshfield_up/__main__.py", "demo"]) == "freshfield demo"
    assert launcher.command_line(["examples/deployment.py", "card", "6"]) == "python examples/deployment.py card 6"


def test_the_signals_of_native_code_are_explained():
    assert child_process.describe_exit(-signal.SIGILL).endswith("SIGILL (an instruction this processor does not have)")
    assert child_process.describe_exit(-signal.SIGTERM) == "was killed by SIGTERM"


def test_what_cannot_run_is_refused_in_one_line_before_anything_starts(tmp_path, capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        words = ("demo", "room", "--out", tmp_path / "new", "--port", taken.getsockname()[1])
        assert "is taken by another program" in refusal(capsys, main, *words)
    assert not (tmp_path / "new").exists()
    (out := tmp_path / "run").mkdir()
    (out / "run.json").write_text("{}")
    (learned := out / "learned.npz").write_bytes(b"weights")
    said = refusal(capsys, main, "demo", "room", "--out", out, "--port", free_port(), "--policy", f"bandit:{learned}")
    assert "is emptied first; choose another --out" in said and learned.read_bytes() == b"weights"


def test_a_deployment_in_a_script_says_why_it_cannot_start(tmp_path):
    (tmp_path / "small.yaml").write_text(SMALL.replace("lpips: none", "policy: {name: nothing}"))
    with (
        pytest.raises(DeploymentError, match="the edge server"),
        ff.deployment(tmp_path / "small.yaml", out=tmp_path / "run"),
    ):
        pass
    refused(ScenarioError, "shipped scenarios", ff.deployment, "nothing")


CELL = load("cell")


def test_a_simulated_arm_and_its_driver_belong_to_the_run(monkeypatch, tmp_path):
    monkeypatch.setattr(process_set, "program", lambda name: name)
    found = process_set.process_set(CELL, process_set.Options(tmp_path))
    assert [child.command[1] for child in found.arms + found.drivers] == ["simulate-arm", "drive-arm"]
    assert found.arm_address == "127.0.0.2:30004"
    # Senders stop before receivers: driver, cameras, arm, channel, edge.
    assert [child.name for child in found.children] == ["driver", "node", "arm", "emulator", "edge"]


@pytest.mark.slow
def test_the_cell_runs_from_one_command(tmp_path):
    require_ur_rtde()
    mount = CELL.path.parent / CELL.source["arm"]["cameras"]["hand"]
    text = CELL.path.read_text().replace("cell/hand-eye.yaml", str(mount))
    text = re.sub(r"host: \S+", f"host: {own_address()}", text)
    (tmp_path / "cell.yaml").write_text(text.replace("width: 128", "width: 48").replace("height: 128", "height: 48"))
    words = [str(tmp_path / "cell.yaml"), "--out", str(out := tmp_path / "run"), "--port", str(free_port())]
    process = subprocess.Popen([sys.executable, "-m", "freshfield_up.cli", "demo", *words])
    try:
        wait_until(lambda: read_status(out / "edge.json").get("updates", {}).get("count", 0) >= 30, "no updates", 400.0)
        process.terminate()
        assert process.wait(300.0) == 0
    finally:
        process.kill()
    frames = read_status(out / "report.json")["frames"]
    assert frames["closes"] and frames["by_camera"]["hand"]["delivered"] > 5
    assert "43 viewpoints in 62 stops\n" in (out / "log-driver.txt").read_text()
    # The arm sets out when the field can learn: after the emulator, which waits for the edge to serve.
    # All may begin within one row; but processes are numbered in their order.
    last = json.loads((out / "processes.jsonl").read_text().splitlines()[-1])
    numbers = int(Path("/proc/sys/kernel/pid_max").read_text())
    assert 0 < (last["driver"]["pid"] - last["emulator"]["pid"]) % numbers < numbers // 2


def test_an_earlier_run_outlives_starts_that_fail(tmp_path):
    prepare(tmp_path, {"run": 1}).close()
    (tmp_path / "report.json").write_text("good")
    for failed in (2, 3):
        prepare(tmp_path, {"run": failed}).close()
        (tmp_path / f"log-cam0{failed}.txt").write_text("failed")
    assert [p.name for p in (tmp_path / EARLIER).iterdir()] == ["report.json"]
    assert {p.name for p in tmp_path.iterdir()} == {MARKER, EARLIER, "log-cam03.txt"}


def test_a_start_that_is_killed_before_its_marker_is_written_or_while_it_moves_files_loses_none(tmp_path):
    (tmp_path / MARKER).touch()
    prepare(tmp_path, {"run": 1}).close()
    for name in ("field.npz", "edge.json"):
        (tmp_path / name).write_text(name)
    part = tmp_path / f".{EARLIER}"
    part.mkdir()
    (tmp_path / "edge.json").rename(part / "edge.json")
    prepare(tmp_path, {"run": 2}).close()
    assert {p.name for p in (tmp_path / EARLIER).iterdir()} == {"field.npz", "edge.json"} and not part.exists()


def test_an_earlier_run_is_replaced_and_a_link_in_it_is_not_followed(tmp_path):
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "photo").write_text("keep")
    out = tmp_path / "out"
    prepare(out, {"run": 1}).close()
    for name in ("ledger-edge-edge-1.tsv", "frontier.json", ".edge.json.4f.part", "decision-000012.png"):
        (out / name).write_text("old")
    (out / "decisions").symlink_to(precious)
    prepare(out, {"run": 2}).close()
    forget_earlier(out)
    assert list(out.iterdir()) == [out / MARKER] and (precious / "photo").read_text() == "keep"
    assert json.loads((out / MARKER).read_text()) == {KEY: [], "run": 2}


@pytest.mark.parametrize(
    ("marker", "error"),
    [
        (None, "not an earlier run's"),
        (json.dumps({KEY: [1]}), "not of a run of this version"),
        ("", "not of a run of this version"),
        (json.dumps({KEY: []}), "holds thesis.tex, which no run wrote"),
    ],
)
def test_anything_else_is_refused_and_left_alone(tmp_path, marker, error):
    (tmp_path / "thesis.tex").write_text("years of work")
    (tmp_path / "edge.json").write_text("{}")
    if marker is not None:
        (tmp_path / MARKER).write_text(marker)
    before = {path.name: path.read_text() for path in tmp_path.iterdir()}
    refused(FolderError, error, prepare, tmp_path, {})
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == before


def test_a_run_that_is_still_going_on_and_a_file_in_the_place_of_the_folder_are_refused(tmp_path):
    with prepare(tmp_path, {"run": 1}), pytest.raises(FolderError, match="another run is writing"):
        prepare(tmp_path, {"run": 2})
    assert json.loads((tmp_path / MARKER).read_text()) == {KEY: [], "run": 1}
    refused(FolderError, "cannot use", prepare, tmp_path / MARKER, {})


def test_the_line_says_what_the_processes_wrote_and_what_is_missing_or_damaged_leaves_gaps(tmp_path):
    nothing = "0/13 cameras; no update yet; no channel yet"
    assert status_line(tmp_path, 13) == nothing
    cameras, channel = [{"age_ms": 80.0 + 300 * i} for i in range(13)], {"preset": "ch6", "counts": {"forwarded": 481}}
    edge = {"cameras": cameras, "updates": {"count": 9, "ms_p50": 812.0}, "scores": {"psnr_db": 25.125}}
    for name, said in (("edge.json", edge), ("channel.json", channel)):
        (tmp_path / name).write_text(json.dumps(said))
    assert status_line(tmp_path, 13) == (
        "13/13 cameras, age 1880 ms (median); 9 updates, 812 ms each, PSNR 25.12 dB; "
        "ch6, forwarded 481, delay error p99 - ms"
    )
    so_far = {"now_psnr_db": 24.0, "all_psnr_db": 25.5, "refined": True}
    (tmp_path / "edge.json").write_text(json.dumps({**edge, "so_far": so_far, "paused": True}))
    said = "each, held out now 24.00 dB, all frames so far 25.50 dB, at refined poses (paused); "
    assert said in status_line(tmp_path, 13)
    (tmp_path / "channel.json").write_text("[1, 2")
    (tmp_path / "edge.json").write_text(json.dumps({"cameras": "none", "updates": {"count": "many"}}))
    assert status_line(tmp_path, 13) == nothing


def test_the_summary_is_the_conclusion_and_whether_all_frames_are_accounted_for(tmp_path):
    lost = {"closes": False, "doubts": ["2,014 lines of the ledgers were lost", "another"]}
    for found, expected in (
        ({"closes": True, "cut_off": 2}, "; all accounted for, 2 of them cut off by the end of a process\n"),
        (lost, "; NOT ALL ACCOUNTED FOR: 2,014 lines of the ledgers were lost; another\n"),
    ):
        frames, sentences = {"captured": 3, "sent": 3, "delivered": 3, "rejected": {}, **found}, ["Good.", "Late."]
        (tmp_path / "report.json").write_text(json.dumps({"conclusion": sentences, "frames": frames}))
        said = summarize(tmp_path)
        assert said.startswith("\nGood.\nLate.\nframes     3 captured, 3 sent") and expected in said


def python(tmp_path: Path, code: str, name: str = "one") -> Child:
    return Child(name, f"process {name}", [sys.executable, "-c", code], tmp_path / f"log-{name}.txt")


def test_a_child_becomes_its_command_and_runs_no_python_between_fork_and_exec(tmp_path, monkeypatch):
    """There it might wait forever for a lock that another thread of the launcher held."""
    options: list[str] = []
    start = subprocess.Popen
    monkeypatch.setattr(child_process.subprocess, "Popen", lambda *a, **b: options.extend(b) or start(*a, **b))
    child = python(tmp_path, "import os, signal, sys; print(os.getpid(), sys.argv, signal.getsignal(signal.SIGTERM))")
    child.start()
    wait_until(lambda: not child.running, "it did not end")
    assert f"\n{child.pid} ['-c'] {int(signal.SIG_DFL)}\n" in child.log.read_text()
    assert "preexec_fn" not in options and "start_new_session" in options


def test_stop_terminates_first_and_kills_after_the_grace_time(tmp_path):
    answers = {"obedient": "lambda *_: sys.exit(print('goodbye'))", "stubborn": "signal.SIG_IGN"}
    code = "import signal, sys, time\nsignal.signal(signal.SIGTERM, {})\nprint('up')\ntime.sleep(60)"
    obedient, stubborn = (python(tmp_path, code.format(answer), name) for name, answer in answers.items())
    for child in (obedient, stubborn):
        child.start()
        wait_until(lambda child=child: "\nup\n" in child.log.read_text(), "it did not start")
    began = time.monotonic()
    child_process.stop([python(tmp_path, ""), obedient, stubborn], grace_s=1.0)  # the first has not begun
    assert time.monotonic() - began < 5.0
    assert not obedient.running and not stubborn.running
    assert not obedient.killed and obedient.process.returncode == 0 and "goodbye" in obedient.log.read_text()
    assert stubborn.killed and stubborn.process.returncode == -signal.SIGKILL


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells children that their parent is gone")
def test_no_child_outlives_a_launcher_that_was_killed_outright(tmp_path):
    launcher = """
import sys, time
from pathlib import Path
from freshfield_up.child_process import Child
child = Child("c", "c", [sys.executable, "-c", "import time; time.sleep(60)"], Path(sys.argv[1]))
child.start()
print(child.pid, flush=True)
time.sleep(60)
"""
    deploy = Path(child_process.__file__).parents[1]
    command = [sys.executable, "-c", launcher, str(tmp_path / "log.txt")]
    with subprocess.Popen(command, cwd=deploy, stdout=subprocess.PIPE) as parent:
        pid = int(parent.stdout.readline())
        assert alive(pid)
        parent.kill()
    wait_until(lambda: not alive(pid), "the child outlived its parent")


def start(command: str, words: list[str], before: str = "", **streams: int) -> subprocess.Popen[bytes]:
    """The command as its installed script starts it. before: Python that runs first."""
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    module, _, function = scripts[command].partition(":")
    code = f"import sys; sys.argv = {[command, *words]}; {before}\nimport {module}; sys.exit({module}.{function}())"
    return subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, **streams)


@pytest.mark.parametrize("after_s", [0.05, 0.4])
def test_ctrl_c_while_it_starts_prints_no_traceback(after_s):
    words = ["simulate", "--preset", "ch6", "--seconds", "1e6"]
    process = start("channel-emu", words, "import re, signal; print(flush=True)", stdout=subprocess.PIPE)
    process.stdout.readline()  # Python itself has started; installed scripts import re, too
    time.sleep(after_s)
    process.send_signal(signal.SIGINT)
    errors = process.communicate(timeout=30)[1]
    assert b"Traceback" not in errors and b"ignored" not in errors
    if after_s == 0.05:
        assert process.returncode == -signal.SIGINT  # it was still importing


@pytest.mark.parametrize(
    ("command", "words", "unbuffered"),
    [("freshfield", ["scenario", "keys", "effects"], ""), ("channel-emu", ["presets"], "1")],
)
def test_output_that_nobody_reads_ends_it_without_a_word(command, words, unbuffered, tmp_path, monkeypatch):
    """Where it is buffered, the last of it is written at the end."""
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    monkeypatch.chdir(tmp_path)
    reader, writer = os.pipe()
    os.close(reader)
    process = start(command, words, stdout=writer)
    os.close(writer)
    assert process.communicate(timeout=30)[1] == b""
    assert process.returncode == 141  # as shells say of SIGPIPE


def test_the_status_of_a_command_is_passed_on():
    process = start("freshfield", ["demo", "no-such-scenario"], stdout=subprocess.DEVNULL)
    assert b"no-such-scenario" in process.communicate(timeout=30)[1] and process.returncode == 2


def healthy(*words: str, camera: str | None = None) -> bool:
    """What the check says, given its words and the camera of its container."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["healthy", *words])
        patch.delenv("CAMERA", raising=False)
        if camera:
            patch.setenv("CAMERA", camera)
        return health_check.main() == 0


def test_a_server_is_healthy_while_it_says_so():
    server = grpc.server(futures.ThreadPoolExecutor(1))
    servicer = health.HealthServicer()
    health_pb2_grpc.add_HealthServicer_to_server(servicer, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        servicer.set("", health_pb2.HealthCheckResponse.SERVING)
        assert healthy("--serving", f"127.0.0.1:{port}")
        servicer.set("", health_pb2.HealthCheckResponse.NOT_SERVING)
        assert not healthy("--serving", f"127.0.0.1:{port}")
    finally:
        server.stop(None).wait()
    assert not healthy("--serving", f"127.0.0.1:{port}")


def test_a_node_is_healthy_while_its_own_status_is_fresh(tmp_path):
    assert not healthy("--node", str(tmp_path))
    (tmp_path / "node-cam01.json").write_text("{}")
    assert healthy("--node", str(tmp_path)) and healthy("--node", str(tmp_path), camera="cam01")
    assert not healthy("--node", str(tmp_path), camera="cam02"), "a neighbor's file is not this one's"
    old = time.time() - 60
    os.utime(tmp_path / "node-cam01.json", (old, old))
    assert not healthy("--node", str(tmp_path), camera="cam01")
