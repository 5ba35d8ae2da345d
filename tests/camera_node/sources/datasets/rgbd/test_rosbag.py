"""ROS bags, and MCAP files in Foxglove's messages, written by the packages of both."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_node.cli import _recording, main
from camera_node.sources.datasets.formats import open_dataset
from camera_node.sources.datasets.rgbd import foxglove
from edge_server.experiments.scenes.recorded import load_recorded
from freshfield.geometry import Pose, look_at
from tests.camera_node.sources.datasets.photos import fails, opened
from tests.support import turned_jpeg

mcap = pytest.importorskip("mcap_protobuf.writer", reason="needs the extra mcap")
rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="needs the extra ros")

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration  # noqa: E402
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage  # noqa: E402
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform  # noqa: E402
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

START_NS = 1_700_000_000 * 10**9
STORE = get_typestore(Stores.ROS2_HUMBLE)
K = [40.0, 0, 15.5, 0, 41.0, 11.5, 0, 0, 1]
P = [38.0, 0, 15.0, 0, 0, 39.0, 11.0, 0, 0, 0, 1, 0]
MM = np.random.default_rng(0).integers(400, 5000, (24, 32)).astype(np.uint16)
MM[2] = 0
PICTURE = cv2.resize(np.random.default_rng(1).integers(0, 256, (4, 5, 3), dtype=np.uint8), (32, 24))
MOUNT = Pose.from_matrix(look_at([0.1, 0.0, 0.3], [1.0, 0.0, 0.3]))  # of the camera on the robot
EYE = "camera_optical"


def type_(name: str):
    return STORE.types[name.replace("/", "/msg/")]


def header(t_ns: int, frame: str):
    return type_("std_msgs/Header")(type_("builtin_interfaces/Time")(t_ns // 10**9, t_ns % 10**9), frame)


def transform(t_ns: int, parent: str, child: str, pose: Pose):
    w, x, y, z = pose.quaternion
    moved = type_("geometry_msgs/Transform")(
        type_("geometry_msgs/Vector3")(*pose.translation_m), type_("geometry_msgs/Quaternion")(x, y, z, w)
    )
    return type_("geometry_msgs/TransformStamped")(header(t_ns, parent), child, moved)


def transforms(*each):
    return type_("tf2_msgs/TFMessage")(list(each))


def image(t_ns: int, encoding: str, values: np.ndarray, frame: str = EYE, big: bool = False):
    values = np.ascontiguousarray(values)
    data = values.reshape(-1).view(np.uint8)
    return type_("sensor_msgs/Image")(header(t_ns, frame), *values.shape[:2], encoding, big, values.strides[0], data)


def compressed(t_ns: int, form: str, data: bytes, frame: str = EYE):
    return type_("sensor_msgs/CompressedImage")(header(t_ns, frame), form, np.frombuffer(data, np.uint8))


def info(t_ns: int, model: str = "plumb_bob", d: tuple = (0.0,) * 5, k: list = K, frame: str = EYE):
    roi = type_("sensor_msgs/RegionOfInterest")(0, 0, 0, 0, False)
    numbers = (np.array(values, np.float64) for values in (d, k, np.eye(3).ravel(), P))
    return type_("sensor_msgs/CameraInfo")(header(t_ns, frame), 24, 32, model, *numbers, 0, 0, roi)


def drive(t_s: float) -> Pose:
    return Pose((1.0, 0.0, 0.0, 0.0), (0.5 * t_s, 0.0, 0.0))


def robot(frames: int = 3) -> list:
    """A robot that drives: map -> odom (rare), odom -> base (every 40 ms), base -> camera (static)."""
    said = [("/tf_static", START_NS + n, transforms(transform(START_NS + n, "base", EYE, MOUNT))) for n in (0, 10**9)]
    shift = Pose((1.0, 0.0, 0.0, 0.0), (10.0, 0.0, 0.0))
    for n in range(frames):
        said.append(("/tf", 0, transforms(transform(START_NS + n * 10**8, "map", "odom", shift))))
    for n in range(-1, 3 * frames):
        t_ns = START_NS + n * 40_000_000
        said.append(("/tf", t_ns, transforms(transform(t_ns, "odom", "/base", drive(n * 0.04)))))
    said.append(("/camera/camera_info", START_NS, info(START_NS)))
    return said


def write(where: Path, said: list, storage: str = "MCAP", later_ns: int = 1) -> Path:
    """Write (topic, log time or 0: a little after the last, message)."""
    with rosbag2.Writer(where, version=9, storage_plugin=rosbag2.StoragePlugin[storage]) as bag:
        topics, last = {}, START_NS
        for topic, t_ns, message in sorted(said, key=lambda each: each[1] or last):
            if topic not in topics:
                topics[topic] = bag.add_connection(topic, message.__msgtype__, typestore=STORE)
            last = max(last + later_ns, (t_ns + 5_000_000) * later_ns)
            bag.write(topics[topic], last, STORE.serialize_cdr(message, message.__msgtype__))
    return where


def pictures(frames: int = 3) -> list:
    said = []
    for n in range(frames):
        t_ns = START_NS + n * 100_000_000
        said.append(("/camera/image_raw", t_ns, image(t_ns, "rgb8", PICTURE)))
        said.append(("/camera/aligned_depth/image_raw", t_ns, image(t_ns + 8_000_000, "16UC1", MM)))
    return said


@pytest.mark.parametrize(("storage", "as_file"), [("MCAP", False), ("SQLITE3", True)])
def test_images_depth_and_the_chain_of_transforms_of_a_bag(tmp_path, storage, as_file):
    bag = write(tmp_path / "run", robot() + pictures(), storage)
    if as_file:
        bag = next(file for file in bag.iterdir() if file.suffix in (".mcap", ".db3"))
    _, found = open_dataset(bag)
    assert found.cameras == (EYE,) and found.moving and found.carried and len(found) == 3
    assert not found.notes and not found.missing
    still = load_recorded(bag, holdout="3")
    assert still.carried and still.timed and (len(still.training), len(still.held_out)) == (2, 1)
    for n, record in enumerate(found):
        at = drive(0.1 * n).matrix() @ MOUNT.matrix()
        at[0, 3] += 10.0
        assert np.allclose(record.camera_to_world, at, atol=1e-9), "interpolated between two samples of odom -> base"
        assert record.time_s == pytest.approx(0.1 * n) and np.array_equal(record.read(), PICTURE)
        assert (record.intrinsics.cx, record.intrinsics.cy) == (16.0, 12.0)
        depth = record.depth()
        assert np.array_equal(depth.counts, MM) and depth.after_image_ns == 8_000_000


def png(values: np.ndarray) -> bytes:
    return cv2.imencode(".png", values)[1].tobytes()


JPEG = cv2.imencode(".jpg", PICTURE)[1].tobytes()
BAYER = np.random.default_rng(3).integers(0, 256, (24, 32), dtype=np.uint8)


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (image(START_NS, "bgra8", np.dstack([PICTURE[..., ::-1], PICTURE[..., :1]])), PICTURE),
        (image(START_NS, "mono8", PICTURE[..., 0]), PICTURE[..., [0, 0, 0]]),
        (image(START_NS, "bayer_rggb8", BAYER), cv2.cvtColor(BAYER, cv2.COLOR_BayerRGGB2RGB)),
        (compressed(START_NS, "rgb8; png compressed bgr8", png(PICTURE[..., ::-1])), PICTURE),
        (compressed(START_NS, "jpeg", turned_jpeg(JPEG, 3)), cv2.imdecode(np.frombuffer(JPEG, np.uint8), 1)[..., ::-1]),
        (image(START_NS, "16UC1", MM.astype(">u2"), big=True), MM),
        (compressed(START_NS, "16UC1; compressedDepth png", bytes(12) + png(MM)), MM),
    ],
)
def test_encodings_of_images_and_of_depth(tmp_path, message, expected):
    is_depth = expected is MM
    bag = write(tmp_path / "run", [*robot(), *(pictures(1)[:1] if is_depth else []), ("/any", START_NS, message)])
    record = open_dataset(bag)[1][0]
    assert np.array_equal(record.depth().counts if is_depth else record.read(), expected)


def test_images_of_a_topic_that_were_logged_at_the_same_time_are_told_apart(tmp_path):
    second = [("/camera/image_raw", 1, image(START_NS + 10**8, "rgb8", PICTURE[::-1]))]
    found = open_dataset(write(tmp_path / "run", robot() + pictures(1) + second, later_ns=0))[1]
    assert [np.array_equal(each.read(), PICTURE[::-1]) for each in found] == [False, True]


def test_of_several_topics_of_a_frame_one_is_taken_and_named(tmp_path):
    t = START_NS
    said = [
        ("/camera/image_raw", t, image(t, "rgb8", PICTURE)),
        ("/camera/image_mono", t, image(t, "mono8", PICTURE[..., 0])),
        ("/other/image_rect", t, image(t, "rgb8", PICTURE, "other")),
        ("/other/camera_info", t, info(t, d=(0.1, 0, 0, 0, 0), frame="other")),
        ("/tf", t, transforms(transform(t, "map", "other", MOUNT))),
        ("/apart/image", t, image(t, "rgb8", PICTURE, "apart")),
        ("/apart/camera_info", t, info(t, frame="apart")),
        ("/tf", t, transforms(transform(t, "elsewhere", "apart", MOUNT))),
        ("/bare/image", t, image(t, "rgb8", PICTURE, "bare")),
        ("/bare/camera_info", t, info(t, k=[0.0] * 9, frame="bare")),
    ]
    found = open_dataset(write(tmp_path / "run", robot() + said))[1]
    assert found.cameras == (EYE, "other") and np.array_equal(found.of(EYE)[0].read(), PICTURE)
    rectified = found.of("other")[0].intrinsics
    assert (rectified.fx, rectified.cy, rectified.distorted) == (38.0, 11.5, False), "of image_rect it is P"
    notes = "\n".join(found.notes)
    assert "/camera/image_mono are of the same instants as those of /camera/image_raw: left out" in notes
    assert "apart hangs on elsewhere, which no transform joins to map: left out" in notes
    assert "bare has no CameraInfo of a calibrated camera (whose K is not 0): left out" in notes


@pytest.mark.stability
@pytest.mark.parametrize(
    ("said", "message"),
    [
        (info(START_NS, k=[np.nan] * 9), "not finite"),
        (info(START_NS, "rational_polynomial", (0.1,) * 8), "undistort the images"),
        (transforms(transform(START_NS, "base", "map", MOUNT)), "form a circle"),
        (transforms(transform(START_NS, "map", EYE, MOUNT)), "hangs on map and on base: keep one"),
        (transforms(transform(START_NS, "base", EYE, Pose((0, 0, 0, 0), (0, 0, 0)))), "quaternion"),
    ],
)
def test_what_a_bag_gets_wrong_is_one_line(tmp_path, said, message):
    topic = "/tf" if "TF" in said.__msgtype__ else "/info"
    fails(message, open_dataset, write(tmp_path / "run", [(topic, START_NS, said), *robot(), *pictures(1)]))


@pytest.mark.stability
def test_a_damaged_bag_is_named_and_one_without_poses_says_so(tmp_path):
    bag = write(tmp_path / "run", robot() + pictures())
    whole = (bag / "run.mcap").read_bytes()
    for data in (b"", whole[:20], b"RIFF" + whole):
        (bag / "run.mcap").write_bytes(data)
        fails("run: cannot be read as a ROS bag", open_dataset, bag)
    (bag / "metadata.yaml").write_text("a: b\nc\n")
    fails("run: cannot be read as a ROS bag", open_dataset, bag)
    bare = write(tmp_path / "bare", pictures())
    fails(f"no image in ROS messages .*: {EYE} has no CameraInfo", open_dataset, bare)
    gone = [transform(START_NS + n * 10**10, "map", "base", MOUNT) for n in (1, 2)]
    said = [each for each in robot() if "odom" not in str(each[2])] + [("/tf", 0, transforms(*gone)), *pictures()]
    fails("3 images of camera_optical have no pose within 50 ms", open_dataset, write(tmp_path / "late", said))


def test_a_bag_is_played_without_a_scenario(tmp_path, capsys):
    left = [("/left/camera_info", START_NS, info(START_NS, frame="left"))]
    left += [("/left/image", t, image(t, "rgb8", PICTURE, "left")) for t in (START_NS, START_NS + 10**8)]
    left.append(("/tf", 0, transforms(transform(START_NS, "base", "left", MOUNT))))
    bag = write(tmp_path / "run", [*robot(), *pictures(), *left])
    scenario = _recording(bag, f"hand={EYE},left", 3)
    sources = opened(scenario)
    assert set(sources) == {"hand", "left"} and scenario.seed == 3
    shot = sources["hand"].read(1)
    assert np.array_equal(shot.image, PICTURE) and shot.pose.translation_m == pytest.approx((10.15, 0.0, 0.3))
    for names, expected in (("hand=nowhere", "the data has no camera 'nowhere'"), ("a b", "--as a b: ")):
        assert main(["run", str(bag), "--as", names, "--to", "127.0.0.1:1"]) == 2
        assert expected in capsys.readouterr().err


def write_foxglove(file: Path, encoding: str = "16UC1", frames: int = 3, d: tuple = (), **depth) -> Path:
    with file.open("wb") as stream, mcap.Writer(stream) as writer:

        def add(topic: str, message, t_ns: int) -> None:
            message.timestamp.FromNanoseconds(t_ns)
            writer.write_message(topic, message, log_time=t_ns + 5_000_000, publish_time=t_ns)

        lens = CameraCalibration(frame_id="front", width=32, height=24, K=K, D=d, distortion_model="plumb_bob")
        add("/camera_info", lens, START_NS)
        for n in range(frames):
            t_ns = START_NS + n * 100_000_000
            for number, at_ns in ((n - 0.2, t_ns - 20_000_000), (n + 0.2, t_ns + 20_000_000)):
                matrix = look_at([2.0, 0.0, 1.0], [0.0, 0.0, 0.5])
                matrix[:3, 3] += [0.0, 0.1 * number, 0.0]
                moved = FrameTransform(parent_frame_id="map", child_frame_id="front")
                w, x, y, z = Pose.from_matrix(matrix).quaternion
                moved.rotation.w, moved.rotation.x, moved.rotation.y, moved.rotation.z = w, x, y, z
                moved.translation.x, moved.translation.y, moved.translation.z = matrix[:3, 3]
                add("/tf", moved, at_ns)
            add("/color", CompressedImage(frame_id="front", format="png", data=png(PICTURE[..., ::-1])), t_ns)
            raw = RawImage(frame_id="front", width=32, height=24, encoding="bgr8", step=96)
            raw.data = PICTURE[..., ::-1].tobytes()
            add("/color_raw", raw, t_ns + 50_000_000)
            values = MM if encoding == "16UC1" else (MM / 1000.0).astype(np.float32)
            padded = np.pad(values, ((0, 0), (0, 2)))  # rows may be longer than the image
            message = RawImage(frame_id="front", width=32, height=24, encoding=encoding, step=padded.strides[0])
            message.data = padded.tobytes()
            for name, value in depth.items():
                setattr(message, name, value)
            add("/depth", message, t_ns + 8_000_000)
    return file


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_images_depth_and_poses_of_a_recording(tmp_path, encoding):
    write_foxglove(tmp_path / "run.mcap", encoding)
    found = open_dataset(tmp_path)[1]
    assert found.cameras == ("front",) and found.moving and len(found) == 6
    assert [record.depth is not None for record in found] == [True, False] * 3, "the raw images are 42 ms away"
    for n in range(3):
        record = found[2 * n]
        assert np.array_equal(record.read(), PICTURE) and np.array_equal(found[2 * n + 1].read(), PICTURE)
        assert record.time_s == pytest.approx(0.1 * n)
        assert np.allclose(record.camera_to_world[:3, 3], [2.0, 0.1 * n, 1.0], atol=1e-6)
        assert (record.intrinsics.cx, record.intrinsics.cy) == (16.0, 12.0)
        measured = record.depth()
        assert np.array_equal(measured.counts, MM) and measured.meters_per_count == 0.001
        assert measured.after_image_ns == 8_000_000 and measured.intrinsics is None
    (tmp_path / "walk.mcap").touch()  # which of the two?
    for load in (open_dataset, foxglove.load_dataset):
        fails(r"run\.mcap, walk\.mcap.* name the file itself", load, tmp_path)


@pytest.mark.stability
def test_damage_of_a_file_is_named(tmp_path):
    file = write_foxglove(tmp_path / "run.mcap")
    whole = file.read_bytes()
    for data in (b"", whole[:-100], b"RIFF" + whole, whole.replace(bytes.fromhex("28b52ffd"), bytes(4))):  # Zstandard
        file.write_bytes(data)
        fails(r"run\.mcap: cannot be read as MCAP", open_dataset, file)
    fails(r"nine numbers K, and plumb_bob's", open_dataset, write_foxglove(file, d=(0.1, 0, 0, 0, 0, 0.3)))
    fails("no image in Foxglove's messages", open_dataset, write_foxglove(file, frames=0))


@pytest.mark.stability
@pytest.mark.parametrize("options", [{"data": b"12"}, {"width": 0}, {"step": 3}])
def test_damaged_depth_is_named_and_costs_only_itself(tmp_path, options):
    found = open_dataset(write_foxglove(tmp_path / "run.mcap", **options))[1]
    assert np.array_equal(found[0].read(), PICTURE)
    fails("/depth: .* (is|are) no image of ", found[0].depth)
