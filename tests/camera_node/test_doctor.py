"""The doctor finds what is wrong, names what to do, and moves nothing."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import pytest
import yaml

from camera_node import coverage_check, doctor
from camera_node.cli import main
from camera_node.settings import source_config
from camera_node.sources.registry import open_sources
from freshfield.clock import WallClock
from freshfield.coverage import REACHED, REACHED_WITH_DEPTH
from freshfield.scenario import load
from freshfield.transport import Transport
from tests.camera_node.robot.arm.simulated import simulated_arm
from tests.camera_node.sources.datasets.photos import edited, photo_scenario, write_photos
from tests.camera_node.sources.devices.mjpeg import NetworkCamera
from tests.camera_node.sources.devices.test_live import CALIBRATION
from tests.conftest import ROOT
from tests.integration.peer import Peer


def examined(capsys, *arguments):
    """Exit code, and part -> (ok, said)."""
    code = main(["doctor", "--json", *arguments])
    found = json.loads(capsys.readouterr().out)
    assert found["ok"] == (code == 0)
    return code, {part["part"]: (part["ok"], part["said"]) for part in found["parts"]}


def cell_at(folder: Path, host: str, **arm) -> str:
    data = yaml.safe_load(load("cell").path.read_text())
    mount = load("cell").path.parent / data["source"]["arm"]["cameras"]["hand"]
    data["source"]["arm"].update({"host": host, "cameras": {"hand": str(mount)}, **arm})
    file = folder / "cell.yaml"
    file.write_text(yaml.safe_dump(data))
    return str(file)


def test_without_a_scenario_the_machine_is_examined(capsys, tmp_path):
    _, parts = examined(capsys, "--out", str(tmp_path / "not" / "there" / "yet"))
    assert parts["python"][0] and parts["disk"][0] and "synchronized" in parts["clock"][1]
    assert parts["network"][0] is None and parts["scenario"][0] is None
    main(["doctor"])
    said = capsys.readouterr().out
    assert "ok     python" in said and "-      scenario" in said


def test_security_files_that_do_not_exist_are_refused_before_any_check(capsys, tmp_path):
    assert main(["doctor", "--token-file", str(tmp_path / "none")]) == 2
    said = capsys.readouterr()
    assert said.out == "" and f"cannot read {tmp_path / 'none'}" in said.err


@pytest.mark.slow  # 7 s
def test_an_arm_that_is_well(capsys, tmp_path, host):
    with simulated_arm(host):
        _, parts = examined(capsys, cell_at(tmp_path, host, frequency_hz=10))
    assert parts["arm"] == (True, parts["arm"][1]) and "running" in parts["arm"][1]
    assert parts["package ur"][0] and parts["hand-eye"][1].endswith("hand eye-in-hand, 65 mm away")
    assert parts["arm's path"][0] and "of 51 viewpoints" in parts["arm's path"][1]


def test_a_tour_that_leaves_a_side_out_and_the_examples_calibration_are_wrong(capsys, tmp_path, host):
    path = {**load("cell").source["arm"]["path"], "radius_m": 0.55}
    code, parts = examined(capsys, cell_at(tmp_path, host, path=path, simulated=False))
    ok, said = parts["arm's path"]
    assert code == 1 and ok is False
    assert 3 <= int(re.search(r"reaches (\d+) of 51 viewpoints: change radius_m", said)[1]) < 0.6 * 51
    assert parts["hand-eye"][0] is False and "still the example's" in parts["hand-eye"][1]


def test_every_fault_is_named_in_one_call(capsys, monkeypatch, tmp_path, host):
    def broken():
        raise RuntimeError("adjtimex failed\nlast error 5")

    monkeypatch.setattr(doctor, "_clock", broken)
    monkeypatch.setattr(doctor, "LEAST_FREE_GB", 1e9)
    monkeypatch.setattr(doctor, "_PACKAGES", {"ur": (("nowhere", "ur-rtde"),)})
    scenario = cell_at(tmp_path, host, cameras={"hand": "none.yaml"})
    code, parts = examined(capsys, scenario, "--to", "127.0.0.1:9")
    assert code == 1 and parts["clock"] == (False, "RuntimeError: adjtimex failed last error 5")
    for part, said in {
        "disk": "make room",
        "network": "does a firewall stand between",
        "package ur": "ur-rtde is not installed: pip install 'freshfield[ur]'",
        "hand-eye": "none.yaml",
        "arm": "simulate-arm",
        "arm's path": "none.yaml",
    }.items():
        assert parts[part][0] is False and said in parts[part][1], part


def test_a_scenario_that_is_wrong_is_said_like_everything_else(capsys, tmp_path):
    file = tmp_path / "bad.yaml"
    file.write_text("cameras: {count: 2}\nsource: {kind: oak, sockets: CAM_A}\n")
    code, parts = examined(capsys, str(file))
    assert code == 1 and parts["scenario"][0] is False and "did you mean 'socket'" in parts["scenario"][1]


def bench_with(folder: Path, camera: NetworkCamera, **source) -> str:
    """A scenario with one calibrated network camera, eye."""
    (folder / "calibration.json").write_text(json.dumps(CALIBRATION))
    source = {
        "kind": "camera",
        "devices": {"eye": camera.address},
        "calibration": "calibration.json",
        "first_frame_s": 10,
        **source,
    }
    file = folder / "bench.yaml"
    file.write_text(yaml.safe_dump({"cameras": {"ids": ["eye"]}, "source": source}))
    return str(file)


def test_a_camera_is_opened_and_watched(capsys, tmp_path):
    camera = NetworkCamera(WallClock())
    file = bench_with(tmp_path, camera, fps=15)
    _, parts = examined(capsys, file)
    camera.close()
    assert parts["camera eye"][0] and parts["camera eye"][1].startswith("64 x 48, ")
    assert parts["camera eye"][1].endswith("stamped by their arrival, less latency_ms; its lens as calibrated")
    assert parts["calibration"] == (True, "calibration.json: 1 cameras")
    (tmp_path / "calibration.json").write_text(json.dumps({"other": CALIBRATION["eye"]}))
    _, parts = examined(capsys, file)
    assert parts["calibration"] == (False, "calibration.json: it lacks eye")
    assert parts["camera eye"][0] is False and "no camera at http" in parts["camera eye"][1]


def test_a_tracker_beside_a_camera_is_asked_for_the_pose_of_now(capsys, tmp_path):
    camera = NetworkCamera(WallClock())
    file = bench_with(tmp_path, camera, trajectory={"files": {"eye": "poses.txt"}, "max_gap_ms": 60_000})
    _, parts = examined(capsys, file)
    assert parts["tracker"][0] is False and "poses.txt: there is no pose yet" in parts["tracker"][1]
    (tmp_path / "poses.txt").write_text(f"{time.time():.6f} 1 2 3 0 0 0 1\n")
    _, parts = examined(capsys, file)
    camera.close()
    assert parts["tracker"][0] and re.fullmatch(r"eye: a pose \d+ ms from now", parts["tracker"][1])


@pytest.mark.parametrize("asked, ok", [(40, False), (4, True)])
def test_a_camera_at_a_fraction_of_the_rate_that_was_asked_for_is_wrong(capsys, tmp_path, asked, ok):
    camera = NetworkCamera(WallClock(), fps=12.0)
    _, parts = examined(capsys, bench_with(tmp_path, camera, fps=asked))
    camera.close()
    found, said = parts["camera eye"]
    assert found is ok and 2.0 < float(re.search(r"([\d.]+) frames a second", said)[1]) < 16.0
    assert ok or f"of the {asked} asked: is it too dark" in said


async def test_a_peer_tells_its_time():
    peer = await Peer(clock=WallClock(offset_ns=3_000_000_000)).start()
    found, bound = await doctor._exchange(peer.address, Transport())
    await peer.stop()
    assert abs(found - 3000.0) <= bound + 1.0


def test_a_data_set_is_opened_and_its_images_are_read(capsys, tmp_path):
    folder = write_photos(tmp_path / "set", 24).parent
    scenario = {"cameras": {"count": 2}, "source": {"kind": "transforms", "data": str(folder)}}
    (tmp_path / "s.yaml").write_text(yaml.safe_dump(scenario))
    (folder / "images/003.png").unlink()
    _, parts = examined(capsys, str(tmp_path / "s.yaml"))
    said = f"{folder}: 23 images of 1 cameras; 1 of 24 images are missing, first images/003.png"
    assert parts["data"][0] and parts["data"][1].startswith(said)
    whole = (folder / "images/004.png").read_bytes()
    (folder / "images/004.png").write_bytes(whole[:300])
    ok, text = examined(capsys, str(tmp_path / "s.yaml"))[1]["data"]
    assert not ok and "images/004.png: damaged or cut short" in text


def test_a_note_on_a_data_set_is_said_once(capsys, caplog, tmp_path):
    """Several checks open the set, and each time its notes go to the log."""
    file = write_photos(tmp_path / "set", 8)
    edited(file, lambda data: [frame.update(time=10.0 + k) for k, frame in enumerate(data["frames"])])
    scenario = {"cameras": {"count": 1}, "source": {"kind": "transforms", "data": str(file.parent)}}
    (tmp_path / "s.yaml").write_text(yaml.safe_dump(scenario))
    note = "8 images of one moving camera, each with its own time: taken for a scene that stands still"
    main(["doctor", str(tmp_path / "s.yaml")])
    assert capsys.readouterr().out.count(note) == 1 and note not in caplog.text


def test_data_that_are_missing_are_said_once(capsys, tmp_path):
    _, parts = examined(capsys, "fox", "--data", str(tmp_path))
    wrong = [part for part, (ok, text) in parts.items() if "does not exist" in text]
    assert wrong == ["data"] and parts["poses and coverage"] == (None, "not examined: they need the data")


def test_what_fixed_cameras_see_is_reckoned_and_drawn(capsys, tmp_path):
    drawn = tmp_path / "plan.svg"
    _, parts = examined(capsys, "quad", "--plan", str(drawn))
    assert parts["coverage"][0] and "50 % by two or more, 54 degrees apart. One more camera" in parts["coverage"][1]
    assert drawn.read_text().count("<polygon") == 4 + 1
    assert "with 4 cameras with depth sensors was shown at 26.2 dB, 22.3 where it moves" in parts["coverage"][1]


def test_what_doctor_promises_was_measured():
    rigs = json.loads((ROOT / "docs/results/few-cameras.json").read_text())["rigs"]
    measured = {n: (rigs[k]["mean_db"], rigs[k]["mean_moving_db"]) for n, k in ((2, "duo"), (3, "room3"), (4, "quad"))}
    assert measured == REACHED_WITH_DEPTH
    assert REACHED[4] == (rigs["room4plain"]["mean_db"], rigs["room4plain"]["mean_moving_db"])


@pytest.mark.parametrize(("count", "carried"), [(3, 2), (7, 6), (35, 30)])
def test_a_camera_that_is_carried_is_not_taken_for_a_fixed_one(tmp_path, count, carried):
    """Its photos loop: shot 30 of 2, 6 or 30 of them is shot 0 again. Each eighth is a held-out camera's."""
    file = write_photos(tmp_path / "set", count)

    def said(loop):
        scenario = photo_scenario(file, 2, loop=loop)
        config = source_config(scenario)
        assert open_sources(scenario, config, ["cam01"], None)["cam01"].contents == carried
        return coverage_check.check(scenario, config, None, None)

    for loop in ("back-and-forth", "restart"):
        assert said(loop).startswith("not reckoned: the cameras move, ")
    first = json.loads(file.read_text())["frames"][0]["transform_matrix"]
    edited(file, lambda data: [frame.update(transform_matrix=first) for frame in data["frames"]])
    assert not said("restart").startswith("not reckoned")
