"""A scenario with a simulated arm: which processes start in which order."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from freshfield.scenario import load
from freshfield_up import commands
from freshfield_up.status import read_json
from tests.camera_node.robot.arm.simulated import own_address, require_ur_rtde
from tests.deploy.test_up import Up
from tests.support import wait_until

CELL = load("cell")


def test_a_simulated_arm_and_its_driver_belong_to_the_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(commands, "program", lambda name: name)
    found = commands.process_set(CELL, tmp_path, 8080)
    assert [child.command[1] for child in found.arms + found.drivers] == ["simulate-arm", "drive-arm"]
    assert found.arm_address == "127.0.0.2:30004"
    # Senders stop before receivers: driver, cameras, arm, channel, edge.
    assert [child.name for child in found.children] == ["driver", "node", "arm", "emulator", "edge"]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_cell_runs_from_one_command(tmp_path: Path) -> None:
    require_ur_rtde()
    mount = CELL.path.parent / CELL.source["arm"]["cameras"]["hand"]
    text = CELL.path.read_text().replace("../lab/hand-eye-example.yaml", str(mount))
    text = re.sub(r"host: \S+", f"host: {own_address()}", text)
    text = text.replace("width: 128", "width: 48").replace("height: 128", "height: 48")
    run = Up(tmp_path, scenario=text)
    try:
        wait_until(
            lambda: read_json(run.out / "edge.json").get("updates", {}).get("count", 0) >= 30, "no updates", 400.0
        )
        run.process.terminate()
        assert run.process.wait(300.0) == 0, run.output
    finally:
        run.process.kill()
    frames = read_json(run.out / "report.json")["frames"]
    assert frames["closes"] and frames["by_camera"]["hand"]["delivered"] > 5
    assert "43 viewpoints in 62 stops\n" in (run.out / "log-driver.txt").read_text()
    # The arm sets out when the field can learn: after the emulator, which waits for the edge to serve.
    # All may begin within one row; but processes are numbered in their order.
    last = json.loads((run.out / "processes.jsonl").read_text().splitlines()[-1])
    numbers = int(Path("/proc/sys/kernel/pid_max").read_text())
    assert 0 < (last["driver"]["pid"] - last["emulator"]["pid"]) % numbers < numbers // 2
