"""Checks of ports: which are free, and which servers answer already."""

from __future__ import annotations

import http.client
import os
import socket
import urllib.request

# Child processes are started by fork and exec. gRPC's fork handlers would first stop gRPC's threads, which
# sometimes hangs the launcher. A process that calls exec does not need the handlers.
os.environ["GRPC_ENABLE_FORK_SUPPORT"] = "0"

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from freshfield.scenario import ScenarioError
from freshfield.transport import Transport
from freshfield_up import launcher_constants as tuned

LOOPBACK = "127.0.0.1"


def free_ports(count: int) -> list[int]:
    """``count`` different free loopback ports. If another program takes one meanwhile, the process that
    should listen there reports it and the run ends."""
    sockets = [socket.socket() for _ in range(count)]
    try:
        for s in sockets:
            s.bind((LOOPBACK, 0))
        return [s.getsockname()[1] for s in sockets]
    finally:
        for s in sockets:
            s.close()


def check_free(port: int) -> None:
    """Raises ScenarioError where something listens on the loopback port."""
    with socket.socket() as s:
        s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as servers do: ignores TIME_WAIT
        try:
            s.bind((LOOPBACK, port))
        except OSError:
            raise ScenarioError(f"port {port} is taken by another program; choose one with --port (PORT=)") from None


def is_serving(address: str, timeout_s: float = tuned.ANSWER_S, transport: Transport | None = None) -> bool:
    """Whether the gRPC health service at ``host:port`` says SERVING."""
    with (transport or Transport()).channel(address) as channel:
        try:
            stub = health_pb2_grpc.HealthStub(channel)
            reply = stub.Check(health_pb2.HealthCheckRequest(), timeout=timeout_s)
        except grpc.RpcError:
            return False
        return bool(reply.status == health_pb2.HealthCheckResponse.SERVING)


def accepts(address: str) -> bool:
    """Whether a server accepts connections at ``host:port``."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=tuned.ANSWER_S).close()
    except OSError:
        return False
    return True


def page_answers(port: int) -> bool:
    """Whether the page on the loopback port answers with a document."""
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with direct.open(f"http://{LOOPBACK}:{port}/", timeout=tuned.PAGE_ANSWER_S) as answer:
            return bool(answer.status == 200)
    except (OSError, http.client.HTTPException):
        return False
