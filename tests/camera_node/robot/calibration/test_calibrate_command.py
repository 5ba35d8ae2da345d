"""``camera-node calibrate`` as a person meets it."""

from __future__ import annotations

import json
import sys

import cv2
import numpy as np
import pytest

from camera_node.cli import main
from camera_node.robot.arm.hand_eye_mount import read_hand_eye
from camera_node.robot.calibration.files import pairs_json, read_visp_pose
from camera_node.robot.calibration.hand_eye.calibrate import angle_deg, distance_mm
from camera_node.robot.calibration.hand_eye.samples import inverse
from camera_node.robot.calibration.targets import parse_target
from tests.camera_node.robot.calibration import known_truth as simulated
from tests.camera_node.robot.calibration.known_truth import streams
from tests.camera_node.robot.calibration.pictures import noisy_samples, write_poses
from tests.camera_node.sources.datasets.photos import BOMB
from tests.conftest import data_dir

X = simulated.CAMERA_IN_HAND


def hand_eye(*arguments) -> int:
    return main(["calibrate", "hand-eye", *map(str, arguments)])


@pytest.fixture
def pairs(tmp_path):
    file = tmp_path / "pairs.json"
    file.write_text(json.dumps(pairs_json(noisy_samples(15, np.random.default_rng(1)))))
    return file


def test_json_is_the_answer_and_what_it_is_worth_and_nothing_else_is_printed(pairs, capsys):
    assert hand_eye("--pairs", pairs, "--json") == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert list(found) == [
        "transform",
        "time_offset_s",
        "residual_mm",
        "residual_deg",
        "method",
        "std_mm",
        "std_deg",
        "warnings",
    ]
    assert 0.0 < found["std_mm"] < 1.0 and 0.0 < found["std_deg"] < 0.2 and found["warnings"] == []
    assert found["method"] == "refined" and found["time_offset_s"] == 0.0 and said.err == ""
    assert distance_mm(np.array(found["transform"]), X) < 1.5
    assert hand_eye("--pairs", pairs, "--json", "--method", "tsai") == 0
    assert json.loads(capsys.readouterr().out)["method"] == "tsai"


def test_scripts_are_warned_too(tmp_path, capsys):
    few = tmp_path / "few.json"
    few.write_text(json.dumps(pairs_json(noisy_samples(6, np.random.default_rng(1)))))
    assert hand_eye("--pairs", few, "--json") == 0
    said = capsys.readouterr()
    assert "6 poses: 10 to 20 well spread ones" in json.loads(said.out)["warnings"][0]
    assert said.err.startswith("note: 6 poses: 10 to 20")


@pytest.mark.parametrize("wrong", ["inverted", "millimeters"])
def test_nonsense_is_refused_and_not_an_answer(wrong, tmp_path, capsys):
    good = noisy_samples(15, np.random.default_rng(1))
    hand, target = good.hand.copy(), good.target.copy()
    if wrong == "inverted":
        target = inverse(target)
    else:
        hand[:, :3, 3] *= 1e3
        target[:, :3, 3] *= 1e3
    file, out = tmp_path / "pairs.json", tmp_path / "hand.yaml"
    file.write_text(json.dumps([[h.tolist(), t.tolist()] for h, t in zip(hand, target)]))
    assert hand_eye("--pairs", file, "--json", "--out", out) == 2
    said = capsys.readouterr()
    assert "not their inverses, in meters" in said.err and said.out == "" and not out.exists()


def test_an_offset_between_two_clocks_beginnings_is_told_and_not_written(tmp_path, capsys):
    hand, target = streams(simulated.Sweep(0.15), 12.0, 1.7e9, np.random.default_rng(5))
    write_poses(tmp_path / "hand.csv", hand.times_ns, hand.poses)
    write_poses(tmp_path / "seen.csv", target.times_ns, target.poses)
    tracks = "--hand", tmp_path / "hand.csv", "--target", tmp_path / "seen.csv", "--json"
    assert hand_eye(*tracks) == 0
    assert "the two streams count from different beginnings" in capsys.readouterr().err
    out = tmp_path / "hand.yaml"
    assert hand_eye(*tracks, "--out", out) == 2
    assert "the node would refuse a time offset of 1700000000 s" in capsys.readouterr().err
    assert not out.exists()


def test_the_table_the_file_and_the_picture(pairs, tmp_path, capsys):
    out, plot = tmp_path / "hand.yaml", tmp_path / "hand.png"
    assert hand_eye("--pairs", pairs, "--out", out, "--plot", plot) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in ("tsai", "park", "horaud", "andreff", "daniilidis", "refined"))
    assert "standard deviation" in said and "the arm's noise, estimated" in said
    loaded = read_hand_eye(out)
    assert distance_mm(loaded.transform, X) < 1.5
    assert loaded.details["poses"] == 15 and 0.2 < loaded.details["arm_noise_mm"] < 1.0
    assert cv2.imread(str(plot)) is not None


def test_streams_with_an_unknown_offset_and_untidy_stamps(tmp_path, capsys):
    hand, target = streams(simulated.Sweep(0.15), 12.0, 0.4321, np.random.default_rng(5))
    order = np.arange(len(hand.times_ns))
    order[100:104] = [103, 100, 102, 101]
    order = np.insert(order, 500, 499)
    write_poses(tmp_path / "hand.csv", hand.times_ns[order], hand.poses[order])
    write_poses(tmp_path / "seen.csv", target.times_ns, target.poses)
    assert hand_eye("--hand", tmp_path / "hand.csv", "--target", tmp_path / "seen.csv", "--json") == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert found["time_offset_s"] == pytest.approx(0.4321, abs=5e-4)
    assert distance_mm(np.array(found["transform"]), X) < 1.0
    assert "hand: 1 stamps came twice (the first is used), 3 out of order" in said.err


def test_a_real_folder(capsys):
    folder = data_dir("handeye_visp_franka")
    assert hand_eye(folder, "--board", "chessboard:9x6:23.6mm", "--method", "park", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    published = np.loadtxt(folder / "expected_eMc.txt")
    assert distance_mm(np.array(found["transform"]), published) < 1.0
    assert angle_deg(np.array(found["transform"]), published) < 0.1
    assert found["residual_mm"] == pytest.approx(5.4, abs=0.05)
    assert found["residual_deg"] == pytest.approx(0.456, abs=0.001)


def test_mistakes_are_one_line(tmp_path, capsys, pairs):
    def fails(*arguments) -> str:
        assert hand_eye(*arguments) == 2
        said = capsys.readouterr().err
        assert said.startswith("camera-node: ") and said.count("\n") == 1, said
        return said

    assert "expected one of FOLDER" in fails()
    assert "expected one of FOLDER" in fails("--pairs", pairs, "--live", "room")
    assert "expected one of FOLDER" in fails("--hand", pairs)
    assert "expected one of FOLDER" in fails("--live", "room", "--target", pairs)
    assert "none.json: no such file" in fails("--pairs", tmp_path / "none.json")
    for option in ("--board", "--lens", "--camera", "--samples"):
        assert f"{option}: goes with " in fails("--pairs", pairs, option, "x")
    assert "--moving: goes with " in fails("--pairs", pairs, "--moving")
    assert "--max-gap-ms: goes with --hand CSV or --live" in fails(tmp_path, "--max-gap-ms", "5")
    assert "--camera ID: say which" in fails("--live", "room", "--board", "qr:60mm")
    assert "--method: expected one of tsai" in fails("--pairs", pairs, "--method", "magic")
    assert "--board SPEC" in fails(tmp_path)
    assert "has 0 camera XML files" in fails(tmp_path, "--board", "qr:60mm")
    live = "--live", "room", "--camera", "cam00", "--board", "qr:60mm"
    assert "expected positive" in fails(*live, "--want-mm", "-1")
    target = "--hand", pairs, "--target", pairs
    for wrong in ("nan", "inf", "-1"):
        assert "--max-gap-ms: expected a positive number" in fails(*target, "--max-gap-ms", wrong)
    pairs.write_text(json.dumps([[[[10**400] * 4] * 4] * 2]))
    assert "pair 1: expected [hand in base, target in camera]: " in fails("--pairs", pairs)
    file = tmp_path / "x.csv"
    file.write_text("t,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n1,2,3\n")
    assert "x.csv:3: expected t tx ty tz" in fails("--hand", file, "--target", file)


@pytest.mark.parametrize("option", ["--out", "--plot"])
def test_an_answer_is_not_lost_with_its_file(option, tmp_path, capsys, pairs):
    (tmp_path / "no").touch()
    assert hand_eye("--pairs", pairs, "--json", option, tmp_path / "no" / "folder.png") == 2
    said = capsys.readouterr()
    assert distance_mm(np.array(json.loads(said.out)["transform"]), X) < 1.5
    assert said.err.startswith(f"camera-node: {option}: ")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("target qr:60mm --out board.png --dpi nan", "--dpi: makes a picture nan pixels wide"),
        ("target qr:60mm --out board.png --dpi inf", "--dpi: makes a picture inf pixels wide"),
        ("intrinsics {} --board chessboard:9x6:10mm", "bomb.png: cannot be read as a picture, or is larger"),
    ],
)
def test_numbers_and_pictures_beyond_bounds_are_one_line(arguments, message, tmp_path, capsys):
    (tmp_path / "bomb.png").write_bytes(BOMB)
    assert main(["calibrate", *arguments.format(tmp_path).split()]) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1


@pytest.mark.parametrize("spelling", ["charuco:7x5:30mm:22mm", "apriltag:36h11:0:80mm", "qr:60mm:hello"])
def test_a_printed_target_is_one(spelling, tmp_path, capsys):
    file = tmp_path / "board.png"
    assert main(["calibrate", "target", spelling, "--out", str(file), "--dpi", "200"]) == 0
    assert "must measure" in capsys.readouterr().out
    picture = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    corners = parse_target(spelling).find(picture)
    # Meters a pixel, over the whole target: what --dpi says.
    pixels = np.ptp(corners.pixels[:, 0]) / np.ptp(corners.points[:, 0])
    assert pixels == pytest.approx(200 / 0.0254, rel=0.02)


def test_a_printed_chessboard_measures_what_is_said(tmp_path, capsys):
    """To half a pixel over the whole board, also where a square is not whole pixels (118.1 of them here)."""
    file = tmp_path / "board.png"
    assert main(["calibrate", "target", "chessboard:9x6:10mm", "--out", str(file), "--dpi", "300"]) == 0
    assert "it must measure 100.0 x 70.0 mm" in capsys.readouterr().out
    picture = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    dark = np.argwhere(picture < 128)
    measured_mm = (np.ptp(dark, axis=0) + 1)[::-1] / 300 * 25.4
    assert measured_mm == pytest.approx((100.0, 70.0), abs=0.1)
    corners = parse_target("chessboard:9x6:10mm").find(picture)
    assert np.ptp(corners.pixels[:, 0]) / 300 * 25.4 == pytest.approx(80.0, abs=0.05)


@pytest.mark.parametrize("what", ["hand-eye --pairs x", "intrinsics x --board x"])
def test_without_scipy_it_says_what_to_install(what, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "scipy", None)
    assert main(["calibrate", *what.split()]) == 2
    assert "pip install 'freshfield[calibrate]'" in capsys.readouterr().err


def test_visps_poses_are_rotation_vectors(tmp_path):
    file = tmp_path / "pose_rPe_1.yaml"
    values = map(float, (0.1, 0.2, 0.3, 0, 0, np.pi / 2))
    file.write_text("rows: 6\ncols: 1\ndata: \n" + "".join(f"  - [{v!r}]\n" for v in values))
    found = read_visp_pose(file)
    np.testing.assert_allclose(found[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    assert found[:3, 3].tolist() == [0.1, 0.2, 0.3]
