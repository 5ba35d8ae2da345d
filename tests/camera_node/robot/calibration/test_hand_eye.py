"""Hand-eye calibration on samples whose truth is known, on real ones whose answer was published, on pairs of poses as
programs save them, and guided, with the real detector on rendered images."""

import json
import re
import time
import warnings
from fractions import Fraction

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from camera_node.cli import main
from camera_node.robot.arm.camera_poses import base_matrix, camera_poses
from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, EYE_TO_HAND, read_hand_eye
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye import guided_session
from camera_node.robot.calibration.hand_eye.calibrate import ALL_METHODS, calibrate
from camera_node.robot.calibration.hand_eye.closed_form import METHODS, Residuals, solve
from camera_node.robot.calibration.hand_eye.guided_session import HandEyeSession, missing_turn
from camera_node.robot.calibration.hand_eye.refinement import refine
from camera_node.robot.calibration.hand_eye.samples import Samples, angle_deg, distance_mm, diversity
from camera_node.robot.calibration.inputs import read_visp_folder
from camera_node.robot.calibration.pose_pairs import read_pairs
from camera_node.robot.calibration.targets import WHICH_PRINT, parse_target
from camera_node.settings import source_config
from camera_node.sources.base import Shot, Source
from freshfield.geometry import Pinhole, Pose, se3, se3_inverse, so3_exp
from freshfield.scenario import load
from tests.camera_node.robot.calibration import known_truth
from tests.camera_node.robot.calibration.known_truth import BOARD, LENS, noisy_samples, taken
from tests.camera_node.robot.calibration.test_rig import printed
from tests.conftest import data_dir
from tests.support import refusal, refused

X, Y = known_truth.CAMERA_IN_FLANGE, known_truth.TARGET_IN_BASE


def test_mistakes_are_one_line(capsys):
    for words, why in (
        (("--pairs", "x", "--live", "room"), "expected one of FOLDER"),
        (("--pairs", "x", "--lens", "x"), "--lens: goes with FOLDER or --live SCENARIO, not with"),
        (("--live", "room", "--camera", "cam00", "--board", "chessboard:9x6:10mm", "--seconds", "-1"), "positive"),
    ):
        assert why in refusal(capsys, main, "calibrate", "hand-eye", *words)


@pytest.mark.parametrize("setup", [EYE_IN_HAND, EYE_TO_HAND])
def test_every_method_is_exact_on_exact_samples(setup):
    exact = noisy_samples(12, np.random.default_rng(1), 0.0, 0.0, setup)
    with warnings.catch_warnings():  # nothing overflows or divides by zero
        warnings.simplefilter("error")
        found = calibrate(exact)
    for name in ALL_METHODS:
        np.testing.assert_allclose(found.results[name], X, atol=1e-8 if name == "refined" else 2e-6)
    np.testing.assert_allclose(found.refined.y, Y, atol=1e-8)
    assert Residuals.of(exact, X).rms[0] < 1e-9 and found.refined.std_mm < 1e-3


def test_how_much_the_flange_must_turn():
    for turns_deg, reason in (
        ([[0, 0, 0], [5.1, 0, 0], [0, 5.1, 0]], None),
        ([[0, 0, 0], [4.9, 0, 0], [0, 4.9, 0]], "hardly turned"),
        ([[0, 0, 0], [30, 0, 0], [-30 * np.cos(0.350), 30 * np.sin(0.350), 0]], None),  # axes spread by 8.2 degrees
        ([[0, 0, 0], [30, 0, 0], [-30 * np.cos(0.335), 30 * np.sin(0.335), 0]], "parallel axes"),  # by 7.8
        ([[0, 0, 0], [169, 0, 0], [0, 169, 0]], None),
        ([[0, 0, 0], [171, 0, 0], [0, 171, 0]], "near 180"),
    ):
        flanges = np.array([se3(so3_exp(np.radians(turn)), np.zeros(3)) for turn in turns_deg])
        found = diversity(Samples(flanges, flanges)).reason
        assert found is None if reason is None else reason in str(found)


def test_with_noise_on_the_arm_the_refinement_is_as_exact_as_can_be_and_says_so():
    """15 poses, arm noise .5 mm and .002 rad an axis. The Cramer-Rao bound is .0768 degrees, .410 mm."""
    trials = [noisy_samples(15, np.random.default_rng([7, trial])) for trial in range(24)]
    refined = [refine(samples) for samples in trials]
    found = ([each.x for each in refined], [solve(samples, "tsai") for samples in trials])
    off, off_tsai = ([(angle_deg(x, X), distance_mm(x, X)) for x in each] for each in found)
    said = [(each.std_deg, each.std_mm) for each in refined]
    rms, rms_tsai, rms_said = (np.sqrt(np.mean(np.square(v), axis=0)) for v in (off, off_tsai, said))
    bound = np.array([0.0768, 0.410])
    assert np.all(rms < 1.25 * bound) and np.all(rms > 0.75 * bound) and np.all(rms < rms_tsai)
    np.testing.assert_allclose(rms, rms_said, rtol=0.35)
    noise = [(each.arm_noise_rad, each.arm_noise_m) for each in refined]
    np.testing.assert_allclose(np.mean(noise, axis=0), [0.002, 0.0005], rtol=0.1)


def test_a_few_wrong_samples_are_found_and_hardly_count():
    good = noisy_samples(20, np.random.default_rng(5))
    bad = good.target.copy()
    bad[[3, 11, 17]] = known_truth.add_noise(bad[[3, 11, 17]], np.random.default_rng(6), 0.3, 0.08)
    found = calibrate(Samples(good.flange, bad))
    assert found.refined.outliers == [3, 11, 17]
    assert distance_mm(found.transform, X) < 1.0 < distance_mm(found.results["park"], X)
    assert sum("does not fit the others" in w for w in found.warnings) == 3
    noisy = noisy_samples(12, np.random.default_rng(5), 0.1, 0.02)
    assert any("residuals are large" in warning for warning in calibrate(noisy).warnings)


@pytest.mark.parametrize(
    ("setup", "factor", "says"),
    [(EYE_IN_HAND, 20 / 24, "too small .*24 mm, not 20"), (EYE_TO_HAND, 1.05, "too large .*19 mm, not 20")],
)
def test_a_board_of_another_size_than_said_is_told_and_its_size_found(setup, factor, says):
    said = noisy_samples(15, np.random.default_rng(2), 0.0005, 0.0002, setup).rescaled(1.0 / factor)
    found = calibrate(said, square_m=0.02)
    assert re.search(says, found.warnings[0]) and "--fit-size" in found.warnings[0]
    assert distance_mm(found.transform, X) > 5.0
    fitted = calibrate(said, square_m=0.02, fit_size=True)
    assert re.search(says, fitted.warnings[0]) and distance_mm(fitted.transform, X) < 1.0
    assert refine(said, with_scale=True).scale == pytest.approx(factor, abs=0.003)
    right = said.rescaled(factor)
    assert calibrate(right, fit_size=True).warnings == calibrate(right).warnings == ()


def test_a_real_arm_whose_calibration_was_published():
    folder = data_dir("handeye_visp_franka")
    samples, unused = read_visp_folder(folder, parse_target("chessboard:9x6:23.6mm"), None, EYE_IN_HAND)
    assert len(samples) == 8 and not unused
    published = np.loadtxt(folder / "expected_eMc.txt")
    found = calibrate(samples)
    assert angle_deg(found.transform, published) < 0.13 and distance_mm(found.transform, published) < 0.2
    assert found.residuals.rms == pytest.approx((5.405, 0.459), abs=0.002)
    # This arm is off by millimeters.
    assert 1e-3 < found.refined.arm_noise_m < 1e-2
    park = found.results["park"]
    assert distance_mm(park, published) < 0.05 and angle_deg(park, published) < 0.02
    assert list(found.results) == [*METHODS, "refined"]


def of_turns(turns, noise=(0.002, 0.0005)) -> Samples:
    """Samples of a flange turned by rotation vectors (N, 3) from where it began, somewhere else each time."""
    rng = np.random.default_rng(0)
    flanges = np.array([known_truth.random_flanges(1, rng)[0]] * len(turns)).reshape(-1, 4, 4)
    for flange, turn in zip(flanges, turns):
        flange[:3, :3] = flange[:3, :3] @ so3_exp(turn)
        flange[:3, 3] += rng.normal(0, 0.05, 3)
    targets = known_truth.observed_targets(flanges)
    return Samples(known_truth.add_noise(flanges, rng, *noise) if turns else flanges, targets)


@pytest.mark.stability
@pytest.mark.parametrize(
    ("turns", "reason"),
    [
        ([[0.02 * (-1) ** k, 0.01 * k, 0.3 * k] for k in range(8)], "parallel axes"),
        ([np.eye(3)[k % 3] * 0.035 * (k // 3) for k in range(6)], "hardly turned"),
        ([[0, 0, 0], [np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi]], "near 180 degrees"),
        ([[0, 0, 0], [0.5, 0.5, 0]], "too few poses: 2"),
        ([], "too few poses: 0"),
    ],
)
def test_degenerate_motions_are_refused_with_the_reason(turns, reason):
    refused(CalibrationError, reason, calibrate, of_turns(turns))


@pytest.mark.stability
def test_the_least_that_determines_something_does():
    """Three poses, two turns about axes at right angles."""
    found = refine(of_turns([[0, 0, 0], [0.9, 0, 0], [0, 0.9, 0]], (1e-6, 1e-7)))
    assert distance_mm(found.x, X) < 0.05 and np.isfinite(found.std_mm)


@pytest.mark.stability
def test_motions_that_turn_by_nearly_half_a_turn_among_others_do_no_harm():
    turns = [[0, 0, 0], [np.pi - 0.01, 0, 0], [0, np.pi, 0], [0.6, 0, 0.2], [0, 0.7, 0]]
    found = calibrate(of_turns([*turns, [0.3, -0.4, 0.5], [-0.5, 0.2, 0], [0.1, 0.2, -0.8]]))
    assert distance_mm(found.transform, X) < 4 * found.refined.std_mm + 0.5
    assert any("nearly 180 degrees" in w for w in found.warnings)


@pytest.mark.stability
def test_a_target_seen_at_exactly_half_a_turn():
    flanges = known_truth.random_flanges(10, np.random.default_rng(1))
    targets = se3_inverse(X) @ se3_inverse(flanges) @ (flanges[0] @ X @ np.diag([1.0, -1.0, -1.0, 1.0]))
    assert np.trace(targets[0][:3, :3]) == pytest.approx(-1.0)
    for method in METHODS:
        assert distance_mm(solve(Samples(flanges, targets), method), X) < 0.01
    assert distance_mm(refine(Samples(flanges, targets)).x, X) < 1e-3


@pytest.mark.stability
def test_numbers_that_are_none_are_refused():
    samples = noisy_samples(8, np.random.default_rng(2))
    for value in (np.nan, np.inf):
        samples.flange[3, 0, 3] = value
        refused(CalibrationError, "finite", Samples, samples.flange, samples.target)


def hand_eye(*arguments) -> int:
    return main(["calibrate", "hand-eye", *map(str, arguments)])


def test_the_table_the_file_and_json_which_is_not_lost_with_its_file(tmp_path, capsys):
    pairs, out = tmp_path / "pairs.json", tmp_path / "hand.yaml"
    samples = noisy_samples(15, np.random.default_rng(1))
    pairs.write_text(json.dumps([[h.tolist(), t.tolist()] for h, t in zip(samples.flange, samples.target)]))
    assert hand_eye("--pairs", pairs, "--out", out) == 0
    said = capsys.readouterr().out
    assert all(name in said for name in ALL_METHODS) and "standard deviation" in said
    loaded = read_hand_eye(out)
    assert distance_mm(loaded.transform, X) < 1.5
    assert loaded.details["poses"] == 15 and 0.2 < loaded.details["arm_noise_mm"] < 1.0
    assert hand_eye("--pairs", pairs, "--json", "--out", pairs / "hand.yaml") == 2
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert said.err.startswith("camera-node: --out: ")
    assert list(found) == ["transform", "residual_mm", "residual_deg", "method", "std_mm", "std_deg", "warnings"]
    expected, said = calibrate(samples), [found[key] for key in ("residual_mm", "residual_deg", "std_mm", "std_deg")]
    assert said == pytest.approx([*expected.residuals.rms, expected.refined.std_mm, expected.refined.std_deg])
    np.testing.assert_allclose(found["transform"], loaded.transform, atol=1e-8)
    samples.target[0, 0, 3] += 0.1
    pairs.write_text(json.dumps([[h.tolist(), t.tolist()] for h, t in zip(samples.flange, samples.target)]))
    assert hand_eye("--pairs", pairs, "--json") == 0 and "does not fit the others" in capsys.readouterr().err


def test_nonsense_is_refused_and_not_an_answer():
    good = noisy_samples(15, np.random.default_rng(1))
    inverted = Samples(good.flange, se3_inverse(good.target))
    refused(CalibrationError, "not their inverses, in meters", calibrate, inverted)
    flange, target = (poses * [[1, 1, 1, 1e3]] for poses in (good.flange, good.target))
    flange[:, 3, 3] = target[:, 3, 3] = 1.0
    for samples, what in ((Samples(good.flange, target), "targets"), (Samples(flange, good.target), "flanges")):
        refused(CalibrationError, f"{what} seem to be in millimeters", calibrate, samples)


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
    words = ["calibrate", "target", spec, "--out", file, "--dpi", "nan"]
    assert "--dpi: makes a picture nan pixels wide" in refusal(capsys, main, *words)
    assert "cannot be written" in refusal(capsys, main, "calibrate", "target", spec, "--out", tmp_path / "board")


FLANGES = np.array([se3(so3_exp([0.1 * k, 0.2, -0.3]), [0.1, 0.2 * k, 0.3]) for k in range(3)])
TARGETS = np.array([se3(so3_exp([0.3, -0.2 * k, 0.1]), [0.0, 0.1, 0.4 + k]) for k in range(3)])


def seven(pose: np.ndarray) -> list[float]:
    """x y z qx qy qz qw, as ROS orders them."""
    return [*pose[:3, 3].tolist(), *Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()]


def named(pose: np.ndarray, shift: str = "translation", turn: str = "rotation") -> dict:
    numbers = seven(pose)
    return {shift: dict(zip("xyz", numbers[:3])), turn: dict(zip("xyzw", numbers[3:]))}


def flat(pose: np.ndarray) -> list[float]:
    return pose.ravel().tolist()


def easy_handeye2(flanges: np.ndarray) -> dict:
    return {"samples": [{"robot": named(h), "tracking": named(t)} for h, t in zip(flanges, TARGETS)]}


PAIRS = list(zip(FLANGES, TARGETS))
FORMS = {
    "ours": [[h.tolist(), t.tolist()] for h, t in PAIRS],
    "numbers": [[seven(h), seven(t)] for h, t in PAIRS],
    "poses": [[{"header": {}, "pose": named(h, "position", "orientation")}, {"transform": named(t)}] for h, t in PAIRS],
    "MoveIt": [{"effector_wrt_world": flat(h), "object_wrt_sensor": flat(t)} for h, t in PAIRS],
    "easy_handeye2": easy_handeye2(FLANGES),
    "easy_handeye": {
        "hand_world_samples": {"transforms": [named(h) for h in FLANGES]},
        "camera_marker_samples": {"transforms": [named(t) for t in TARGETS]},
    },
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_is_the_same_pairs(form, tmp_path):
    for suffix, write in (("json", json.dumps), ("yaml", yaml.safe_dump)):
        file = tmp_path / f"pairs.{suffix}"
        file.write_text(write(FORMS[form]))
        found = read_pairs(file, EYE_IN_HAND)
        np.testing.assert_allclose(found.flange, FLANGES, atol=1e-9)
        np.testing.assert_allclose(found.target, TARGETS, atol=1e-9)


def test_easy_handeye_saves_the_base_in_the_flange_for_a_camera_that_stands(tmp_path):
    file = tmp_path / "eye_on_base.samples"
    for form in (easy_handeye2(se3_inverse(FLANGES)), FORMS["MoveIt"]):
        file.write_text(yaml.safe_dump(form))
        np.testing.assert_allclose(read_pairs(file, EYE_TO_HAND).flange, FLANGES, atol=1e-9)


def test_what_is_none_of_them_is_refused_by_name(tmp_path):
    for data, says in (
        ("{", "cannot be read as JSON"),
        ({"hand_world_samples": {"transforms": [1]}, "camera_marker_samples": {"transforms": []}}, "expected a list"),
        ([[[[10**400] * 4] * 4] * 2], "pair 1"),
        ([[[0.0] * 6 + [1.02], seven(TARGETS[0])]], "pair 1: .*no unit quaternion"),
        ([[seven(FLANGES[0])[:6], seven(TARGETS[0])]], "pair 1: .*4 x 4"),
    ):
        file = tmp_path / "pairs.json"
        file.write_text(data if isinstance(data, str) else json.dumps(data))
        refused(CalibrationError, f"pairs.json: {says}", read_pairs, file, EYE_IN_HAND)


def test_it_waits_for_stillness_keeps_what_is_new_and_says_when_there_is_enough():
    images, flanges = taken()
    flanges = known_truth.add_noise(flanges, np.random.default_rng(0), 1e-4, 2e-4)
    session = HandEyeSession(parse_target(BOARD), EYE_IN_HAND)
    steps = []
    for image, flange in zip(images, flanges):
        assert session.offer(image, LENS, flange).outcome == "arm moving"
        steps.append(session.offer(image, LENS, flange))
        assert steps[-1].outcome == "kept"
        assert session.offer(image, LENS, flange).outcome == f"like pose {len(steps)}"
    assert [len(steps), len(session.samples)] == [12, 12]
    assert not steps[0].enough and "turn the flange by 20" in steps[0].advice
    assert steps[-1].enough and steps[-1].advice == "enough"
    found = calibrate(session.samples)
    assert distance_mm(found.transform, X) < 3 * found.refined.std_mm < 1.5
    assert angle_deg(found.transform, X) < 0.1
    step = session.offer(np.ascontiguousarray(images[-1][:, ::-1]), LENS, flanges[-1])
    assert step.outcome == "target not found" and "the picture is mirrored" in step.advice
    # The axis that is missing.
    turns = [[0, 0, 0], [0.4, 0, 0], [0, 0.3, 0], [0.3, 0.3, -0.1]]
    poses = np.array([se3(so3_exp(turn), np.zeros(3)) for turn in turns])
    assert "about its +z" in missing_turn(poses) and "about its +y" in missing_turn(poses[:2])
    assert "bring the target" in missing_turn(poses[:0])


def test_it_asks_for_all_of_a_board_whose_part_fits_two_prints():
    whole = printed(5, 8, legacy=True)
    part = whole.copy()
    part[:, 40 + 80 * 4 :] = 255
    session = HandEyeSession(parse_target("charuco:5x8:30mm:22mm"), EYE_IN_HAND)
    lens = Pinhole(480, 720, 600.0, 600.0, 240.0, 360.0)
    steps = [session.offer(image, lens, np.eye(4)) for image in (part, part, whole, part)]
    assert [step.outcome for step in steps] == ["arm moving", "target unclear", "kept", "like pose 1"]
    assert steps[1].advice == WHICH_PRINT and len(session.samples) == 1


class Recording(Source):
    """Rendered images, each twice, with poses (N, 4, 4) as a scenario's arm gives them: it holds still."""

    camera, fps, intrinsics = "eye", Fraction(500), LENS

    def __init__(self, poses):
        self._images = [cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) for image in taken()[0]]
        self._poses, self.contents = poses, 2 * len(poses)

    def read(self, content):
        if content == 1:
            raise ValueError("no pose near enough")
        return Shot(self._images[content // 2], Pose.from_matrix(self._poses[content // 2]), LENS)


def test_a_source_that_never_repeats_follows_the_time_of_day_as_in_a_node(monkeypatch):
    asked, endless = [], Recording(taken()[1])
    endless.contents = None
    monkeypatch.setattr(endless, "content", lambda tick: asked.append(tick) or 0)
    next(guided_session._shots(endless, "png", None))
    assert asked[0] / 500 == pytest.approx(time.time(), abs=60)


def test_what_it_saves_is_what_the_node_takes_it_for(tmp_path, monkeypatch, capsys):
    """Of a camera that stands, in the axes of the arm's base, wherever that stands in the world."""
    file, out = tmp_path / "bench.yaml", tmp_path / "eye.yaml"
    arm = {"host": "127.0.0.9", "base_m": [0.4, -0.3, 0.1], "base_yaw_deg": 30.0, "cameras": {"eye": None}}
    source = {"kind": "world", "scene": "tile", "codec": "png", "arm": {**arm, "simulated": True}}
    file.write_text(yaml.safe_dump({"cameras": {"ids": ["eye"]}, "source": source}))
    plan = load(str(file))
    config = source_config(plan).arm
    base = base_matrix(config)
    recording = Recording(base @ se3_inverse(taken()[1]))
    monkeypatch.setattr(guided_session, "open_sources", lambda *_: {"eye": recording})
    words = ["--live", str(file), "--camera", "eye", "--board", BOARD, "--out", str(out), "--eye-to-hand", "--json"]
    assert main(["calibrate", "hand-eye", *words]) == 0
    said = capsys.readouterr()
    assert "no pose near enough" in said.err and said.err.splitlines()[-1].endswith("kept: enough")
    found = np.array(json.loads(said.out)["transform"])
    assert distance_mm(found, X) < 0.6 and angle_deg(found, X) < 0.1
    used = msgspec.structs.replace(config, cameras={"eye": str(out)})
    place = camera_poses(plan, used, ["eye"])["eye"].at(0)[0].matrix()
    assert distance_mm(place, base @ X) < 0.6
    file.write_text(file.read_text().replace("eye: null", "eye: eye.yaml"))
    assert "source.arm.cameras: set eye: null for" in refusal(capsys, main, "calibrate", "hand-eye", *words)
