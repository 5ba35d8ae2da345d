"""Ports of this machine: free ones, taken ones, and whether somebody answers on them yet."""

from __future__ import annotations

import http.client
import os
import socket

# Children are started by fork and exec. gRPC would first bring its own threads to rest, and now and then that
# never ends: the launcher hangs between two processes. What execs needs nothing of it.
os.environ["GRPC_ENABLE_FORK_SUPPORT"] = "0"

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

LOOPBACK = "127.0.0.1"


def free_ports(count: int) -> list[int]:
    """Different free loopback ports. Another program could take one before we do: then the process that
    gets it says so and the run ends."""
    sockets = [socket.socket() for _ in range(count)]
    try:
        for s in sockets:
            s.bind((LOOPBACK, 0))
        return [s.getsockname()[1] for s in sockets]
    finally:
        for s in sockets:
            s.close()


def is_free(port: int) -> bool:
    """Whether nobody listens on the loopback port."""
    with socket.socket() as s:
        s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as servers do: TIME_WAIT is no occupant
        try:
            s.bind((LOOPBACK, port))
        except OSError:
            return False
        return True


def is_serving(address: str, timeout_s: float = 0.5) -> bool:
    """Whether the gRPC health service at ``host:port`` says SERVING."""
    options = [("grpc.enable_http_proxy", 0)]
    with grpc.insecure_channel(address, options=options) as channel:
        try:
            stub = health_pb2_grpc.HealthStub(channel)
            reply = stub.Check(health_pb2.HealthCheckRequest(), timeout=timeout_s)
        except grpc.RpcError:
            return False
        return bool(reply.status == health_pb2.HealthCheckResponse.SERVING)


def accepts(address: str, timeout_s: float = 0.5) -> bool:
    """Whether anybody takes a connection at ``host:port``."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout_s).close()
    except OSError:
        return False
    return True


def page_answers(port: int, timeout_s: float = 1.0) -> bool:
    """Whether the page on the loopback port answers with a document."""
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=timeout_s)
    try:
        connection.request("GET", "/")
        return connection.getresponse().status == 200
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()
