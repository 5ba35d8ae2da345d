"""The server for Foxglove, asked by a client that speaks its protocol (subprotocol foxglove.sdk.v1)."""

import json
import re
import struct
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from itertools import count
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import websocket

pytest.importorskip("foxglove", reason="needs the extra foxglove")
pytest.importorskip("foxglove_schemas_protobuf", reason="needs the extra mcap")

from edge_server.cli import main as edge_server
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.splat.snapshot import SplatSnapshot
from edge_server.page.foxglove_live import FoxgloveServer, point_cloud
from edge_server.page.foxglove_live.foxglove_constants import MOST_POINTS
from freshfield.transport import TransportError
from tests.conftest import ROOT
from tests.edge_server.page.preview import CAMERAS, LENS, Preview, publication
from tests.support import refusal, wait_until

MESSAGE = struct.Struct("<BIQ")  # opcode 1, subscription, log time


@pytest.fixture
def served() -> Iterator[tuple[Preview, FoxgloveServer]]:
    preview = Preview()
    server = FoxgloveServer(preview.state, 0)
    preview.start()
    yield preview, server
    server.stop()
    preview.stop()


class Client:
    """Connects; ``channels``: what is advertised, by topic."""

    def __init__(self, server: FoxgloveServer) -> None:
        self.socket = websocket.create_connection(server.url, subprotocols=["foxglove.sdk.v1"], timeout=20)
        assert json.loads(self.socket.recv())["op"] == "serverInfo"
        self.channels: dict[str, dict] = {}
        while "/scores" not in self.channels:
            self.channels |= {c["topic"]: c for c in json.loads(self.socket.recv())["channels"]}
        self._numbers = count(1)

    def subscribe(self, topic: str) -> int:
        number = next(self._numbers)
        asked = {"op": "subscribe", "subscriptions": [{"id": number, "channelId": self.channels[topic]["id"]}]}
        self.socket.send(json.dumps(asked))
        return number

    def first(self, topic: str):
        """The first message of a topic, decoded, and its log time."""
        channel, number = self.channels[topic], self.subscribe(topic)
        while True:
            kind, data = self.socket.recv_data()
            if kind == websocket.ABNF.OPCODE_BINARY and MESSAGE.unpack_from(data)[:2] == (1, number):
                break
        self.socket.send(json.dumps({"op": "unsubscribe", "subscriptionIds": [number]}))
        body, log_ns = data[MESSAGE.size :], MESSAGE.unpack_from(data)[2]
        if channel["encoding"] == "json":
            return json.loads(body), log_ns
        name = channel["schemaName"].removeprefix("foxglove.")
        return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name).FromString(body), log_ns


def test_one_message_of_each_kind_and_the_layout_that_shows_them(served):
    preview, server = served
    client = Client(server)
    held_out = preview.names[CAMERAS // 2]
    image, log_ns = client.first("/cam03/image")
    assert image.frame_id == "cam03" and image.format == "jpeg" and image.timestamp.ToNanoseconds() == log_ns
    decoded = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
    assert decoded.shape == (LENS.height, LENS.width, 3)
    calibration, _ = client.first("/cam03/calibration")
    assert list(calibration.K) == [LENS.fx, 0, LENS.cx - 0.5, 0, LENS.fy, LENS.cy - 0.5, 0, 0, 1]
    transform, _ = client.first("/tf")
    where = preview._poses[transform.child_frame_id]
    assert transform.parent_frame_id == "world"
    assert np.allclose([getattr(transform.translation, a) for a in "xyz"], where[:3, 3])
    quaternion = preview._newest[transform.child_frame_id].pose.quaternion
    assert [getattr(transform.rotation, a) for a in "wxyz"] == [*quaternion]
    assert client.first("/truth/image")[0].frame_id == held_out
    rendered, _ = client.first("/rendered/image")
    seen = cv2.imdecode(np.frombuffer(rendered.data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    exact = 255 * preview.state.renderer.render(preview._poses[held_out], LENS).color
    assert seen.shape == exact.shape and np.abs(seen - exact).mean() < 12, "a moving ball, as JPEG"
    ages, _ = client.first("/ages")
    assert set(ages["cameras"]) == set(preview.names) and 0 <= ages["least_s"] <= ages["most_s"] < 60
    decision, log_ns = client.first("/decisions")
    assert decision["published_ns"] == log_ns and held_out not in decision["selected"]
    assert set(decision) == set(json.loads(client.channels["/decisions"]["schema"])["properties"])
    assert client.first("/scores")[0]["psnr_db"] == 30.0
    # The layout shows topics and values that are served.
    shown = set(re.findall(r'"(/[^"]*)"', (ROOT / "deploy/foxglove-layout.json").read_text()))
    assert len(shown) > 6
    for topic, _, value in (name.partition(".") for name in shown):
        assert not value or value in json.loads(client.channels[topic]["schema"])["properties"], topic


def test_a_score_is_told_again_once_another_held_out_camera_is_in_it():
    said, one = [], replace(publication(5), psnr_db=20.0)
    scores = SimpleNamespace(has_sinks=lambda: True, log=lambda values, log_time: said.append(values["psnr_db"]))
    told = SimpleNamespace(_scores=scores, _decisions=SimpleNamespace(has_sinks=lambda: False), _last_score=None)
    for newest in (one, one, replace(one, psnr_db=21.0)):
        told._state = SimpleNamespace(now_ns=lambda: 7, newest=lambda scored, newest=newest: newest)
        FoxgloveServer._publications(told)
    assert said == [20.0, 21.0]


def test_where_no_camera_is_held_out_the_first_stands_for_it(served):
    preview, server = served
    cameras = preview.state.cameras
    preview.state.cameras = lambda: [replace(camera, held_out=False) for camera in cameras()]
    assert Client(server).first("/truth/image")[0].frame_id == preview.names[0]


def test_points_are_the_gaussians_that_are_seen(served):
    _, server = served
    params = np.zeros((MOST_POINTS + 3, 14), np.float32)
    params[:, :3] = np.linspace(0.0, 1.0, len(params))[:, None]
    params[:, 3:6], params[:, 6], params[:, 10], params[:, 11:14] = -3.0, 1.0, 4.0, (1.2, 0.5, -0.1)
    params[0, 0] = np.nan  # drawn by no renderer
    params[1, 10] = -4.0  # haze
    params[2, 3:6] = -6.0  # too small among so many
    box = SceneBox((1.0, 2.0, 3.0), 2.0, 0.1, True, 2.0, 0.01)
    field = SplatSnapshot(box, params, np.zeros(3, np.float32), None, 1)
    points = point_cloud(field)
    assert len(points) == MOST_POINTS and points["x"][0] == pytest.approx(1.0 + 2.0 * params[3, 0])
    assert (points["red"][0], points["green"][0], points["blue"][0]) == (255, 128, 0)
    server._state = SimpleNamespace(
        renderer=field, now_ns=lambda: 7, cameras=list, publications=lambda _: [], newest=lambda scored: None
    )
    cloud, log_ns = Client(server).first("/points")
    assert (cloud.frame_id, log_ns, cloud.point_stride) == ("world", 7, points.dtype.itemsize)
    assert [f.name for f in cloud.fields] == list(points.dtype.names) and cloud.data == points.tobytes()


def test_a_taken_port_and_a_view_that_fails_are_said(served, caplog):
    preview, server = served
    with pytest.raises(TransportError, match=f"--foxglove-port {server._server.port}: .*in use"):
        FoxgloveServer(preview.state, server._server.port)
    client = Client(server)
    client.first("/rendered/image")
    preview.stop()
    preview.state.publish(preview.state.newest(), SimpleNamespace(at=lambda now_ns: 1 / 0))
    client.subscribe("/rendered/image")
    wait_until(lambda: "serving Foxglove failed: ZeroDivisionError" in caplog.text, "no word of it")
    assert server._thread.is_alive()


def test_it_is_refused_beside_a_login_which_it_would_go_around(tmp_path, capsys):
    (tmp_path / "tokens.txt").write_text("operator abcdefghijklmnop\n")
    words = ["run", "room", "--out", str(tmp_path / "out"), "--foxglove-port", "0"]
    assert "knows no login" in refusal(capsys, edge_server, *words, "--token-file", tmp_path / "tokens.txt")
