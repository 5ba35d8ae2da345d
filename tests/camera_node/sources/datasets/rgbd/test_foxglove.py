"""MCAP files in Foxglove's messages, written by the packages of both."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_node.sources.datasets.formats import open_dataset
from freshfield.geometry import Pose, look_at
from tests.camera_node.sources.datasets.photos import fails

mcap = pytest.importorskip("mcap_protobuf.writer", reason="needs the extra mcap")

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration  # noqa: E402
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage  # noqa: E402
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform  # noqa: E402
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage  # noqa: E402

START_NS = 1_700_000_000 * 10**9
MM = np.random.default_rng(0).integers(400, 5000, (24, 32)).astype(np.uint16)
MM[2] = 0
PICTURE = cv2.resize(np.random.default_rng(1).integers(0, 256, (4, 5, 3), dtype=np.uint8), (32, 24))


def pose(n: int) -> np.ndarray:
    return look_at([2.0, 0.1 * n, 1.0], [0.0, 0.0, 0.5])


def write(file: Path, encoding: str = "16UC1", frames: int = 3, d: tuple = (), **depth) -> Path:
    with file.open("wb") as stream, mcap.Writer(stream) as writer:

        def add(topic: str, message, t_ns: int) -> None:
            message.timestamp.FromNanoseconds(t_ns)
            writer.write_message(topic, message, log_time=t_ns + 5_000_000, publish_time=t_ns)

        k = [40.0, 0, 15.5, 0, 41.0, 11.5, 0, 0, 1]
        lens = CameraCalibration(frame_id="front", width=32, height=24, K=k, D=d, distortion_model="plumb_bob")
        add("/camera_info", lens, START_NS)
        for n in range(frames):
            t_ns = START_NS + n * 100_000_000
            for number, at_ns in ((n - 0.2, t_ns - 20_000_000), (n + 0.2, t_ns + 20_000_000)):
                matrix = pose(0)
                matrix[:3, 3] += [0.0, 0.1 * number, 0.0]
                moved = FrameTransform(parent_frame_id="map", child_frame_id="front")
                w, x, y, z = Pose.from_matrix(matrix).quaternion
                moved.rotation.w, moved.rotation.x, moved.rotation.y, moved.rotation.z = w, x, y, z
                moved.translation.x, moved.translation.y, moved.translation.z = matrix[:3, 3]
                add("/tf", moved, at_ns)
            png = cv2.imencode(".png", PICTURE[..., ::-1])[1].tobytes()
            add("/color", CompressedImage(frame_id="front", format="png", data=png), t_ns)
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
    write(tmp_path / "run.mcap", encoding)
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


@pytest.mark.stability
def test_damage_of_a_file_is_named(tmp_path):
    file = write(tmp_path / "run.mcap")
    whole = file.read_bytes()
    for data in (b"", whole[:-100], b"RIFF" + whole):
        file.write_bytes(data)
        fails(r"run\.mcap: cannot be read as MCAP", open_dataset, file)
    fails(r"nine numbers K, and plumb_bob's", open_dataset, write(file, d=(0.1, 0, 0, 0, 0, 0.3)))
    fails("no image in Foxglove's messages", open_dataset, write(file, frames=0))


@pytest.mark.stability
@pytest.mark.parametrize("options", [{"data": b"12"}, {"width": 0}, {"step": 3}])
def test_damaged_depth_is_named_and_costs_only_itself(tmp_path, options):
    found = open_dataset(write(tmp_path / "run.mcap", **options))[1]
    assert np.array_equal(found[0].read(), PICTURE)
    fails("/depth: .* (is|are) no image of ", found[0].depth)
