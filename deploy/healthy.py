"""Health check of the containers: exit code 0 if the process beside it does its work.

python healthy.py --serving HOST:PORT     the gRPC health service there says SERVING
python healthy.py --fresh 'GLOB'          a matching status file was written in the last ten seconds
"""

from __future__ import annotations

import argparse
import glob
import os
import sys
import time

FRESH_S = 10.0


def is_serving(address: str) -> bool:
    import grpc
    from grpc_health.v1 import health_pb2, health_pb2_grpc

    with grpc.insecure_channel(address, options=[("grpc.enable_http_proxy", 0)]) as channel:
        try:
            reply = health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest(), timeout=2.0)
        except grpc.RpcError:
            return False
        return bool(reply.status == health_pb2.HealthCheckResponse.SERVING)


def is_fresh(pattern: str) -> bool:
    files = glob.glob(pattern)
    return bool(files) and time.time() - max(os.path.getmtime(file) for file in files) < FRESH_S


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--serving", metavar="HOST:PORT")
    which.add_argument("--fresh", metavar="GLOB")
    args = parser.parse_args()
    healthy = is_serving(args.serving) if args.serving else is_fresh(args.fresh)
    return 0 if healthy else 1


if __name__ == "__main__":
    sys.exit(main())
