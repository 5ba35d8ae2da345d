"""The containers' health check against a real server and real files."""

import os
import sys
import time
from concurrent import futures

import grpc
import pytest
from grpc_health.v1 import health, health_pb2, health_pb2_grpc

from freshfield_up import healthy as health_check


def healthy(*words: str, camera: str | None = None) -> bool:
    """What the check says, given its words and the camera of its container."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["healthy", *words])
        patch.delenv("CAMERA", raising=False)
        if camera:
            patch.setenv("CAMERA", camera)
        return health_check.main() == 0


def test_a_server_is_healthy_while_it_says_so():
    server = grpc.server(futures.ThreadPoolExecutor(1))
    servicer = health.HealthServicer()
    health_pb2_grpc.add_HealthServicer_to_server(servicer, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        servicer.set("", health_pb2.HealthCheckResponse.SERVING)
        assert healthy("--serving", f"127.0.0.1:{port}")
        servicer.set("", health_pb2.HealthCheckResponse.NOT_SERVING)
        assert not healthy("--serving", f"127.0.0.1:{port}")
    finally:
        server.stop(None).wait()
    assert not healthy("--serving", f"127.0.0.1:{port}")


def test_a_node_is_healthy_while_its_own_status_is_fresh(tmp_path):
    assert not healthy("--node", str(tmp_path))
    (tmp_path / "node-cam01.json").write_text("{}")
    assert healthy("--node", str(tmp_path)) and healthy("--node", str(tmp_path), camera="cam01")
    assert not healthy("--node", str(tmp_path), camera="cam02"), "a neighbor's file is not this one's"
    old = time.time() - 60
    os.utime(tmp_path / "node-cam01.json", (old, old))
    assert not healthy("--node", str(tmp_path), camera="cam01")
