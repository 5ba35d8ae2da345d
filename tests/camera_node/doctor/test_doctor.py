"""The doctor finds what is wrong, of depth and of poses too, names what to do, and moves nothing."""

import json
import re
from collections.abc import Callable
from contextlib import closing, nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from camera_node.cli import main
from camera_node.doctor import coverage_check, doctor_command, pose_check
from camera_node.doctor.depth_check import DepthView, check, first_views
from camera_node.settings import source_config
from camera_node.synthetic import make_scene
from camera_node.synthetic.depth import DepthRenderer
from camera_node.synthetic.effects.depth_sensor import DepthSensor
from camera_node.synthetic.walk import walks_through
from freshfield.clock import WallClock
from freshfield.depth import DepthImage
from freshfield.geometry import OPENGL_TO_OPENCV, Pinhole, Pose, so3_exp
from freshfield.scenario import load, parse
from freshfield.transport import Transport
from tests.camera_node.depth_source import POSE
from tests.camera_node.robot.arm.simulated import write_cell
from tests.camera_node.sources.datasets.photos import photo_scenario, write_photos
from tests.camera_node.sources.devices.mjpeg import CALIBRATION, NetworkCamera, camera_file
from tests.integration.peer import ClockAhead, Peer
from tests.support import refused


def examined(capsys, *arguments):
    """Exit code, and part -> (ok, said)."""
    code = main(["doctor", "--json", *arguments])
    found = json.loads(capsys.readouterr().out)
    assert found["ok"] == (code == 0)
    return code, {part["part"]: (part["ok"], part["said"]) for part in found["parts"]}


def cell_at(folder: Path, host: str, **changed) -> str:
    mount = load("cell").path.parent / load("cell").source["arm"]["cameras"]["hand"]
    return str(write_cell(folder, host, **{"cameras": {"hand": str(mount)}, **changed}))


def test_without_a_scenario_the_machine_is_examined(capsys, tmp_path):
    _, parts = examined(capsys, "--out", str(tmp_path / "not" / "there" / "yet"))
    assert parts["python"][0] and parts["disk"][0] and "synchronized" in parts["clock"][1]
    assert parts["network"][0] is None and parts["scenario"][0] is None


def test_a_tour_that_leaves_a_side_out_and_the_examples_calibration_are_wrong(capsys, tmp_path, host):
    code, parts = examined(capsys, cell_at(tmp_path, host, path={"radius_m": 0.55}, simulated=False))
    ok, said = parts["arm's path"]
    assert code == 1 and ok is False
    assert 3 <= int(re.search(r"reaches (\d+) of 51 viewpoints: change radius_m", said)[1]) < 0.6 * 51
    assert parts["hand-eye"][0] is False and "still the example's" in parts["hand-eye"][1]


def test_every_fault_is_named_in_one_call(capsys, monkeypatch, tmp_path, host):
    def broken():
        raise RuntimeError("adjtimex failed\nlast error 5")

    monkeypatch.setattr(doctor_command, "_clock", broken)
    monkeypatch.setattr(doctor_command.tuned, "LEAST_FREE_GB", 1e9)
    monkeypatch.setattr(doctor_command, "_PACKAGES", {"ur": (("nowhere", "ur-rtde"),)})
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


def test_a_camera_is_opened_and_watched(capsys, tmp_path):
    with closing(NetworkCamera(WallClock())) as camera:
        file = str(camera_file(tmp_path, camera.address, fps=15, first_frame_s=10))
        _, parts = examined(capsys, file)
    assert parts["camera eye"][0] and parts["camera eye"][1].startswith("64 x 48, ")
    assert parts["camera eye"][1].endswith("stamped by their arrival, less latency_ms; its lens as calibrated")
    assert parts["calibration"] == (True, "calibration.json: 1 cameras") and "tracker" not in parts
    (tmp_path / "calibration.json").write_text(json.dumps({"other": CALIBRATION["eye"]}))
    _, parts = examined(capsys, file)
    assert parts["calibration"] == (False, "calibration.json: it lacks eye")
    assert parts["camera eye"][0] is False and "no camera at http" in parts["camera eye"][1]


def test_a_camera_at_a_fraction_of_the_rate_that_was_asked_for_is_wrong(capsys, tmp_path):
    with closing(NetworkCamera(WallClock(), fps=12.0)) as camera:
        _, parts = examined(capsys, str(camera_file(tmp_path, camera.address, fps=40, first_frame_s=10)))
    ok, said = parts["camera eye"]
    assert not ok and 2.0 < float(re.search(r"([\d.]+) frames a second of the 40 asked: is it too dark", said)[1]) < 16


async def test_a_peer_tells_its_time():
    peer = await Peer(clock=ClockAhead(3_000_000_000)).start()
    found, bound = await doctor_command._exchange(peer.address, Transport())
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


def test_what_fixed_cameras_see_is_reckoned_and_drawn(capsys, tmp_path):
    drawn = tmp_path / "plan.svg"
    _, parts = examined(capsys, "quad", "--plan", str(drawn))
    assert parts["coverage"][0] and "50 % by two or more, 54 degrees apart. One more camera" in parts["coverage"][1]
    assert drawn.read_text().count("<polygon") == 4 + 1
    scenario = photo_scenario(write_photos(tmp_path / "set", 7), 2)
    said = coverage_check.check(scenario, source_config(scenario), None, None)
    assert said.startswith("not reckoned: the cameras move, ")


APART = np.eye(4)
APART[:3, :3], APART[:3, 3] = so3_exp([0.0, 0.05, 0.0]), (-0.03, 0.0, 0.01)


@cache
def rig() -> tuple[DepthView, ...]:
    """Four cameras of the room with depth sensors; that of the last stands beside its camera."""
    scene = make_scene("room", {"supersample": 1})
    views = []
    for n in range(1, 5):
        lens, pose = scene.cameras[f"cam{n:02d}"]
        image = scene.render(f"cam{n:02d}", 1.0)
        sensor = DepthSensor().start(np.random.default_rng(n))
        if n < 4:
            measured = sensor.measure(DepthRenderer(scene.world, lens, pose).depth(1.0), image, lens, 0)
        else:
            small = Pinhole.from_fov(96, 80, 66.0)
            exact = DepthRenderer(scene.world, small, pose @ APART).depth(1.0)
            counts = np.rint(exact * 1e4).astype(np.uint16)
            measured = DepthImage(counts, 1e-4, small, Pose.from_matrix(APART))
        views.append(DepthView(f"cam{n:02d}", image, lens, Pose.from_matrix(pose), measured))
    return tuple(views)


def said(views: list[DepthView]) -> list[str]:
    lines = []
    for view in views:
        try:
            lines.append(check(view, [other for other in views if other is not view]))
        except ValueError as error:
            assert "\n" not in str(error)
            lines.append(f"WRONG {error}")
    return lines


def recounted(view: DepthView, change: Callable[[np.ndarray], np.ndarray]) -> DepthView:
    return replace(view, depth=replace(view.depth, counts=change(view.depth.counts).astype(np.uint16)))


def test_right_depth_is_described():
    lines = said(list(rig()))
    assert all("of it agrees with cam0" in line and "WRONG" not in line for line in lines), lines
    assert lines[0].startswith("128 x 128, ") and " without depth, 1.3 to 6.3 m" in lines[0]
    for view in rig()[:3]:
        assert "its edges are those of the image" in check(view, [])


@pytest.mark.stability
@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda v: v.scaled(0.3048), "that of cam01 seems to be 0.305 times what it should be: is the unit wrong"),
        (lambda v: recounted(v, lambda c: np.where(c > 0, 3000, 0)), "nearly all of it is the same, 3 m"),
        (lambda v: recounted(v, np.zeros_like), "100% without depth: is the scene within the sensor's range"),
        (lambda v: recounted(v, lambda c: np.where(c > 0, 8000 - c, 0)), "are near and far exchanged"),
        (lambda v: recounted(v, lambda c: c[:, ::-1]), "is the pose, a lens"),
        (lambda v: replace(v, pose=POSE), "is the pose, a lens"),
    ],
    ids=["feet", "constant", "holes", "inverted", "mirrored", "nowhere"],
)
def test_wrong_depth_is_told_of_the_camera_that_has_it(change, told):
    first, *others = rig()
    lines = said([change(first), *others])
    assert lines[0].startswith("WRONG") and told in lines[0], lines[0]
    assert not any(line.startswith("WRONG") for line in lines[1:]), lines


@pytest.mark.stability
def test_of_two_cameras_the_one_with_another_unit_is_named_by_both_and_one_alone_by_its_edges():
    lines = said([rig()[0].scaled(0.1), rig()[1]])
    assert all("that of cam01 seems to be 0.1 times what it should be" in line for line in lines), lines
    mirrored = [recounted(view, lambda c: c[:, ::-1]) for view in rig()[:3]]
    lines = [line for view in mirrored for line in said([view])]
    assert sum("its edges are not those of the image" in line for line in lines) >= 2, lines


@pytest.mark.stability
@pytest.mark.filterwarnings("error")
def test_cameras_that_see_nothing_in_common_and_blank_images_are_described():
    away = replace(rig()[1], pose=Pose((1.0, 0.0, 0.0, 0.0), (500.0, 0.0, 0.0)))
    line = check(replace(rig()[0], image=np.zeros_like(rig()[0].image)), [away])
    assert line.startswith("128 x 128, ") and "agrees" not in line and "edges" not in line


@pytest.mark.parametrize(("name", "cameras"), [("duo", ["cam01", "cam02"]), ("room", [])])
def test_scenarios_are_examined_where_they_have_depth(name, cameras):
    scenario = load(name)
    assert [view.camera for view in first_views(scenario, source_config(scenario), None)] == cameras


COUNT, PERIOD_S = 30, 0.1


@cache
def filmed() -> tuple[list[np.ndarray], float]:
    """Small gray images of a walk through the room, and their focal length."""
    scene = make_scene("room", {"people": 0, "width": 160, "height": 120, "supersample": 1})
    walk, lens = walks_through(scene, ["hand"])["hand"], scene.cameras["cam00"][0]
    images = [scene.view(lens, walk.pose(k * PERIOD_S)).image(0.0) for k in range(COUNT)]
    small = [cv2.resize(image, (80, 60), interpolation=cv2.INTER_AREA) for image in images]
    return [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in small], lens.fx / 2


def poses(late_s: float = 0.0) -> np.ndarray:
    walk = walks_through(make_scene("room"), ["hand"])["hand"]
    return np.array([walk.pose(k * PERIOD_S - late_s) for k in range(COUNT)])


def compared(found: np.ndarray) -> str:
    images, focal_px = filmed()
    return pose_check.compare(images, found, focal_px, 1e3 * PERIOD_S)


@pytest.mark.stability
@pytest.mark.parametrize(
    ("late_s", "message"), [(0.0, "move together"), (0.1, "some 1[0-9]{2} ms late"), (-0.2, "some 2[0-9]{2} ms early")]
)
def test_poses_of_another_instant_are_said_with_their_delay(late_s, message):
    with pytest.raises(ValueError, match=message) if late_s else nullcontext():
        assert message in compared(poses(late_s))


@pytest.mark.stability
def test_other_units_other_axes_and_poses_without_rotation_are_said():
    right = poses()
    millimeters, still = right.copy(), right.copy()
    millimeters[:, :3, 3] *= 1e3
    still[:, :3, :3] = np.eye(3)
    for wrong, message in (
        (millimeters, "in meters"),
        (still, "lack the rotation"),
        (right @ OPENGL_TO_OPENCV, "axes"),
    ):
        refused(ValueError, message, compared, wrong)


@pytest.mark.stability
def test_images_that_tell_nothing_are_not_held_against_the_poses():
    noise = np.random.default_rng(0).uniform(0, 255, (COUNT, 60, 80)).astype(np.float32)
    assert "tell nothing" in pose_check.compare(list(noise), poses(), 60.0, 100.0)
    flat = [np.full((60, 80), 90.0, np.float32)] * COUNT
    assert "hardly move" in pose_check.compare(flat, poses(), 60.0, 100.0)


def test_a_recording_is_read_as_it_is_streamed(tmp_path):
    """Its camera stands at first, and some of its images are damaged."""
    images, focal_px = filmed()
    frames = []
    for k, image in enumerate([images[0]] * 3 + images):
        data = cv2.imencode(".png", image.astype(np.uint8))[1].tobytes()
        (tmp_path / f"{k:03d}.png").write_bytes(data[: len(data) // 2] if k in (0, 5) else data)
        matrix = (poses(0.1)[max(k - 3, 0)] @ OPENGL_TO_OPENCV).tolist()
        frames.append({"file_path": f"{k:03d}.png", "transform_matrix": matrix, "time": 2 + k * PERIOD_S})
    data = {"fl_x": focal_px, "w": 80, "h": 60, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    cameras = {"ids": ["hand", "kept"], "held_out": ["kept"], "held_out_every": 8}
    for fps in (1.0 / PERIOD_S, 2.0 / PERIOD_S):  # at twice the recording's rate it shows each image twice
        source = {"kind": "transforms", "data": str(tmp_path), "fps": fps}
        found = parse({"cameras": cameras, "source": source}, tmp_path / "s.yaml")
        refused(ValueError, "100 ms late", pose_check.check, found, source_config(found), None)
