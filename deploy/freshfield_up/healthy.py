"""Health check of the containers: exit code 0 if the process beside it does its work.

python -m freshfield_up.healthy --serving HOST:PORT   the gRPC health service there says SERVING
python -m freshfield_up.healthy --node DIR            a node's status file there is younger than ten seconds:
                                                      the file of the camera $CAMERA, or of any node
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

FRESH_S = 10.0


def is_serving(address: str) -> bool:
    """Whether the gRPC server at ``host:port`` says that it serves."""
    import grpc
    from grpc_health.v1 import health_pb2, health_pb2_grpc

    with grpc.insecure_channel(address, options=[("grpc.enable_http_proxy", 0)]) as channel:
        try:
            reply = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=2.0)
        except grpc.RpcError:
            return False
        return bool(reply.status == health_pb2.HealthCheckResponse.SERVING)


def is_fresh(folder: Path, camera: str | None) -> bool:
    """Whether the node that hosts ``camera`` alone (None: any node) wrote its status lately."""
    files = list(folder.glob(f"node-{camera or '*'}.json"))
    return bool(files) and time.time() - max(file.stat().st_mtime for file in files) < FRESH_S


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--serving", metavar="HOST:PORT")
    which.add_argument("--node", type=Path, metavar="DIR")
    args = parser.parse_args()
    healthy = is_serving(args.serving) if args.serving else is_fresh(args.node, os.environ.get("CAMERA"))
    return 0 if healthy else 1


if __name__ == "__main__":
    sys.exit(main())
