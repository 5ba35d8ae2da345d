"""The containers' health check against a real server and real files."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from concurrent import futures
from pathlib import Path

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc


def healthy(*words: str, **environment: str) -> bool:
    command = [sys.executable, "-m", "freshfield_up.healthy", *words]
    plain = {k: v for k, v in os.environ.items() if k != "CAMERA"}
    done = subprocess.run(command, env={**plain, **environment}, capture_output=True, timeout=30)
    assert done.returncode in (0, 1) and not done.stderr, done.stderr.decode()
    return done.returncode == 0


def test_a_server_is_healthy_while_it_says_so() -> None:
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


def test_a_node_is_healthy_while_its_own_status_is_fresh(tmp_path: Path) -> None:
    assert not healthy("--node", str(tmp_path))
    (tmp_path / "node-cam01.json").write_text("{}")
    assert healthy("--node", str(tmp_path)) and healthy("--node", str(tmp_path), CAMERA="cam01")
    assert not healthy("--node", str(tmp_path), CAMERA="cam02"), "a neighbor's file is not this one's"
    old = time.time() - 60
    os.utime(tmp_path / "node-cam01.json", (old, old))
    assert not healthy("--node", str(tmp_path), CAMERA="cam01")
