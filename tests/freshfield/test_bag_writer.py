"""A session written as a ROS 2 bag, read by rosbags' own reader and by ours."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra ros")
pytest.importorskip("mcap", reason="needs the extra mcap")

from rosbags.highlevel import AnyReader

from camera_node.sources.datasets.formats import open_dataset
from camera_node.sources.datasets.records import DatasetError
from edge_server.live.output.recorder import Recorder
from freshfield import frame as wire
from freshfield import payload
from freshfield.depth import DepthImage
from freshfield.session.bag_writer import BagWriter, _measured
from tests.edge_server.live.output.test_output import PUBLICATION
from tests.freshfield.test_session import LENS, requests
from tests.support import refused


def sent_frames(codec: str = "jpeg", meters_per_count: float = 0.001) -> list:
    """Frames of two cameras: cam-0.b with depth registered to its image, cam01 with a sensor of its own."""
    rng = np.random.default_rng(5)
    sent = list(requests(6, ("cam-0.b", "cam01")))
    for request, _ in sent:
        frame = wire.from_request(request)
        if codec != "jpeg":
            image = payload.decode(request.payload, "jpeg", LENS.width, LENS.height)
            frame = replace(frame, codec=codec, payload=payload.encode(image, codec))
        if frame.camera == "cam-0.b":
            counts = rng.integers(0, 6000, (LENS.height, LENS.width)).astype(np.uint16)
            depth = DepthImage(counts, meters_per_count, after_image_ns=3_000_000)
            frame = replace(frame, depth=depth.encode(), held_out=False)
        request.CopyFrom(wire.to_request(frame))
    return sent


def record(path: Path, sent: list) -> Recorder:
    recorder = Recorder(path, "test")
    for request, arrived_ns in sent:
        recorder.frame(request, arrived_ns)
    recorder.published(PUBLICATION)
    recorder.close()
    return recorder


def captured_ns(request) -> int:
    return request.header.generated_ns + request.header.clock_offset_ns


def test_rosbags_reads_what_was_sent(tmp_path):
    sent = sent_frames()
    bag = record(tmp_path / "bag", sent).file
    assert {path.name for path in bag.iterdir()} == {"metadata.yaml", "bag.mcap"}
    found: dict[str, list] = {}
    with AnyReader([bag]) as reader:
        for connection, t_ns, data in reader.messages():
            found.setdefault(connection.topic, []).append((t_ns, reader.deserialize(data, connection.msgtype)))
    transforms = [transform for _, message in found["/tf"] for transform in message.transforms]
    own = [(request, t_ns) for request, t_ns in sent if request.header.camera_id == "cam-0.b"]
    images, infos = found["/cam_0_b/image/compressed"], found["/cam_0_b/camera_info"]
    poses = [transform for transform in transforms if transform.child_frame_id == "cam-0.b"]
    for (request, arrived_ns), (t_ns, image), (_, info), moved in zip(own, images, infos, poses, strict=True):
        stamp, pose, to = image.header.stamp, request.header.pose, moved.transform
        assert (t_ns, stamp.sec * 10**9 + stamp.nanosec) == (arrived_ns, captured_ns(request))
        assert (image.data.tobytes(), image.format) == (request.payload, "jpeg")
        assert image.header.frame_id == "cam-0.b" and info.header == image.header
        assert (info.width, info.height) == (LENS.width, LENS.height) and tuple(info.d[:4]) == LENS.distortion
        assert np.array_equal(info.k.reshape(3, 3), LENS.opencv()[0])
        assert (to.translation.x, to.translation.y, to.translation.z) == (pose.tx_m, pose.ty_m, pose.tz_m)
        assert (to.rotation.w, to.rotation.x, to.rotation.y) == (pose.qw, pose.qx, pose.qy)
        assert moved.header.frame_id == "world"
    depth = found["/cam01/depth/image"][0][1]
    assert (depth.encoding, depth.header.frame_id) == ("16UC1", "cam01_depth")
    of_realsense = DepthImage(np.ones((2, 3), np.uint16), float(np.float32(0.001)))
    assert _measured(of_realsense)[0] == "16UC1"
    beside = next(transform for transform in transforms if transform.child_frame_id == "cam01_depth")
    assert (beside.header.frame_id, beside.transform.translation.x) == ("cam01", 0.05)
    assert json.loads(found["/decisions"][0][1].data)["number"] == PUBLICATION.number
    names = record(tmp_path / "names", list(requests(6, ("15", "a.b", "a_b"))))._writer._names
    assert names == {"15": "camera_15", "a.b": "a_b", "a_b": "a_b_2"}, "no topic of two, none that begins with a digit"


def test_our_reader_gives_the_same_pixels_and_depth_in_whole_millimeters(tmp_path):
    sent = sent_frames("zstd", 0.0005)
    dataset = open_dataset(record(tmp_path / "bag", sent).file)[1]
    assert set(dataset.cameras) == {"cam-0.b", "cam01"} and dataset.notes == (
        "depth of cam01_depth is in no image's frame: left out",
    )
    own = [request for request, _ in sent if request.header.camera_id == "cam-0.b"]
    for request, image in zip(own, dataset.of("cam-0.b"), strict=True):
        frame = wire.from_request(request)
        assert np.array_equal(image.read(), payload.decode(request.payload, "zstd", LENS.width, LENS.height))
        assert np.allclose(image.camera_to_world, frame.pose.matrix(), rtol=0, atol=1e-12)
        depth, sent_depth = image.depth(), frame.depth.decode()
        assert depth.after_image_ns == 3_000_000 and depth.meters_per_count == 0.001
        assert np.allclose(depth.meters(), sent_depth.meters(), rtol=0, atol=6e-4)


@pytest.mark.stability
def test_what_cannot_be_decoded_costs_itself_and_a_killed_bag_says_how_it_is_read(tmp_path, caplog):
    sent = sent_frames("zstd")
    sent[3][0].payload = b"\0" * 50
    recorder = record(tmp_path / "bag", sent)
    assert recorder.dropped == 1 and "a message is left out" in caplog.text
    assert len(open_dataset(recorder.file)[1]) == len(sent) - 1
    writer = BagWriter(tmp_path / "killed", {})
    for request, arrived_ns in sent[:2]:
        writer.frame(request, arrived_ns)
    refused(ValueError, "Out of range", writer.data, "/scores", "freshfield.Decision", {}, {"psnr_db": float("nan")}, 5)
    writer.abandon()
    assert not (tmp_path / "killed/metadata.yaml").exists()
    refused(DatasetError, "mcap recover", open_dataset, tmp_path / "killed/killed.mcap")
    assert Recorder(tmp_path / "bag", "test").file.name == "bag-2", "a server that starts again keeps the first"
