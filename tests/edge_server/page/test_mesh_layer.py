"""The mesh on the page: made when asked for, hidden again, and a reason where there is none."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import viser

from edge_server.fields import View
from edge_server.page.mesh_layer import NODE, MeshLayer
from tests.edge_server.page.test_page import bare_state, publication
from tests.edge_server.surface.ball import LENS, BallRenderer, poses_around
from tests.waiting import wait_until


class Client:
    """Records notifications."""

    def __init__(self) -> None:
        self.notifications: list[tuple[str, str]] = []

    def add_notification(self, title: str, body: str, **more) -> None:
        self.notifications.append((title, body))


@pytest.fixture
def server():
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield server
    server.stop()


def press(layer: MeshLayer, client: Client) -> None:
    layer._pressed(SimpleNamespace(client=client))
    wait_until(lambda: not layer.button.disabled, "the mesh was not finished", timeout_s=60.0)


def test_a_mesh_comes_and_goes(server):
    pytest.importorskip("skimage", reason="scikit-image is not installed (extra surface)")
    state, client = bare_state(), Client()
    picture = np.zeros((64, 64, 3), np.uint8)
    cameras = tuple(View(f"cam{k}", picture, pose, LENS) for k, pose in enumerate(poses_around(10)))
    state.publish(publication(0), BallRenderer(cameras))
    layer = MeshLayer(server, state)
    press(layer, client)
    assert client.notifications == [] and layer.button.label == "hide mesh"
    assert layer._node is not None and layer._node.name == NODE
    press(layer, client)
    assert layer._node is None and layer.button.label == "show mesh"


def test_a_field_that_has_seen_nothing_has_no_mesh(server):
    client = Client()
    layer = MeshLayer(server, bare_state())
    press(layer, client)
    assert client.notifications == [("No mesh", "the field has not been trained yet")]
    assert layer.button.label == "show mesh" and layer._node is None
