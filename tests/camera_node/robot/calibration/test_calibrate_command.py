"""``camera-node calibrate`` as a person meets it."""

from __future__ import annotations

import json
import sys

import cv2
import numpy as np
import pytest

from camera_node.cli import main
from camera_node.robot.arm.hand_eye_mount import read_hand_eye
from camera_node.robot.calibration.hand_eye.samples import Samples, distance_mm
from camera_node.robot.calibration.targets import parse_target
from freshfield.geometry import se3_inverse
from tests.camera_node.robot.calibration import known_truth
from tests.camera_node.robot.calibration.known_truth import noisy_samples
from tests.camera_node.sources.datasets.photos import BOMB
from tests.conftest import data_dir

X = known_truth.CAMERA_IN_FLANGE


def hand_eye(*arguments) -> int:
    return main(["calibrate", "hand-eye", *map(str, arguments)])


def write_pairs(file, samples) -> None:
    pairs = [[flange.tolist(), target.tolist()] for flange, target in zip(samples.flange, samples.target)]
    file.write_text(json.dumps(pairs))


@pytest.fixture
def pairs(tmp_path):
    file = tmp_path / "pairs.json"
    write_pairs(file, noisy_samples(15, np.random.default_rng(1)))
    return file


def test_json_is_the_answer_and_what_it_is_worth_and_nothing_else_is_printed(pairs, capsys):
    assert hand_eye("--pairs", pairs, "--json") == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    keys = "transform residual_mm residual_deg method std_mm std_deg warnings"
    assert list(found) == keys.split()
    assert 0.0 < found["std_mm"] < 1.0 and 0.0 < found["std_deg"] < 0.2 and found["warnings"] == []
    assert found["method"] == "refined" and said.err == ""
    assert distance_mm(np.array(found["transform"]), X) < 1.5


def test_the_table_and_the_file(pairs, tmp_path, capsys):
    out = tmp_path / "hand.yaml"
    assert hand_eye("--pairs", pairs, "--out", out) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in ("tsai", "park", "horaud", "andreff", "daniilidis", "refined"))
    assert "standard deviation" in said and "the arm's noise, estimated" in said
    loaded = read_hand_eye(out)
    assert distance_mm(loaded.transform, X) < 1.5
    assert loaded.details["poses"] == 15 and 0.2 < loaded.details["arm_noise_mm"] < 1.0


def test_nonsense_is_refused_and_not_an_answer(tmp_path, capsys):
    good, out = noisy_samples(15, np.random.default_rng(1)), tmp_path / "hand.yaml"
    millimeters = Samples(good.flange.copy(), good.target.copy())
    for poses in (millimeters.flange, millimeters.target):
        poses[:, :3, 3] *= 1e3
    for samples in (Samples(good.flange, se3_inverse(good.target)), millimeters):
        write_pairs(tmp_path / "pairs.json", samples)
        assert hand_eye("--pairs", tmp_path / "pairs.json", "--json", "--out", out) == 2
        said = capsys.readouterr()
        assert "not their inverses, in meters" in said.err and said.out == "" and not out.exists()


def test_a_real_folder(capsys):
    folder = data_dir("handeye_visp_franka")
    assert hand_eye(folder, "--board", "chessboard:9x6:23.6mm", "--method", "park", "--json") == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert found["residual_mm"] == pytest.approx(5.411, abs=0.001)
    assert found["residual_deg"] == pytest.approx(0.456, abs=0.001)
    assert found["warnings"][0] in said.err and "8 poses" in said.err


BOARD = ("--board", "chessboard:9x6:10mm")


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ((), "expected one of FOLDER"),
        (("--pairs", "PAIRS", "--live", "room"), "expected one of FOLDER"),
        (("--pairs", "PAIRS", "--lens", "x"), "--lens: goes with FOLDER or --live SCENARIO, not with"),
        (("FOLDER", *BOARD, "--camera", "1"), "--camera: goes with --live SCENARIO, not with"),
        (("--pairs", "PAIRS", "--method", "magic"), "--method: expected one of tsai"),
        (("FOLDER",), "--board SPEC"),
        (("FOLDER", *BOARD), "has 0 camera XML files"),
        (("--live", "room", "--camera", "cam00", *BOARD, "--seconds", "-1"), "positive"),
    ],
)
def test_mistakes_are_one_line(tmp_path, capsys, pairs, words, why):
    given = {"PAIRS": pairs, "FOLDER": tmp_path}
    assert hand_eye(*(given.get(word, word) for word in words)) == 2
    said = capsys.readouterr().err
    assert said.startswith("camera-node: ") and said.count("\n") == 1 and why in said


def test_an_answer_is_not_lost_with_its_file(tmp_path, capsys, pairs):
    (tmp_path / "no").touch()
    assert hand_eye("--pairs", pairs, "--json", "--out", tmp_path / "no" / "hand.yaml") == 2
    said = capsys.readouterr()
    assert distance_mm(np.array(json.loads(said.out)["transform"]), X) < 1.5
    assert said.err.startswith("camera-node: --out: ")


def test_numbers_and_images_beyond_bounds_are_one_line(tmp_path, capsys):
    (tmp_path / "bomb.png").write_bytes(BOMB)
    for words, message in (
        ("target charuco:7x5:30mm:22mm --out board.png --dpi nan", "--dpi: makes a picture nan pixels wide"),
        (f"intrinsics {tmp_path} --board chessboard:9x6:10mm", "bomb.png: cannot be read as a picture, or is larger"),
    ):
        assert main(["calibrate", *words.split()]) == 2
        said = capsys.readouterr().err
        assert message in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("spec", "size"), [("charuco:7x5:30mm:22mm", "210.0 x 150.0"), ("chessboard:9x6:10mm", "100.0 x 70.0")]
)
def test_a_printed_target_measures_what_is_said(spec, size, tmp_path, capsys):
    """Also where a square is not whole pixels."""
    file = tmp_path / "board.png"
    assert main(["calibrate", "target", spec, "--out", str(file), "--dpi", "200"]) == 0
    assert f"it must measure {size} mm" in capsys.readouterr().out
    image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    width = round(parse_target(spec).size_m[0] / 0.0254 * 200)
    assert image.shape[1] == width + 2 * (width // 10), "a white border of a tenth"
    corners = parse_target(spec).find(image)
    # Pixels a meter, over the whole target: what --dpi says.
    pixels = np.ptp(corners.pixels[:, 0]) / np.ptp(corners.points[:, 0])
    assert pixels == pytest.approx(200 / 0.0254, rel=0.001)


def test_without_scipy_it_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "scipy", None)
    assert hand_eye("--pairs", "x") == 2
    assert "pip install 'freshfield[calibrate]'" in capsys.readouterr().err
