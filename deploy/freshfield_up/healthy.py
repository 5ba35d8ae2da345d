"""Health check of a container: exit code 0 if its process works.

python -m freshfield_up.healthy --serving HOST:PORT   the gRPC health service there says SERVING
python -m freshfield_up.healthy --node DIR            a node's status file there is younger than ten seconds:
                                                      that of the camera $CAMERA, or of any node

With mutual TLS a server's check shows the server's own certificate (--tls-cert, --tls-key, --tls-ca).
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

from freshfield.transport import add_arguments, from_arguments
from freshfield_up.launcher_constants import FRESH_S, HEALTH_ANSWER_S
from freshfield_up.ports import is_serving


def is_fresh(folder: Path, camera: str | None) -> bool:
    """Whether the node of ``camera`` (None: any node) wrote its status within the last FRESH_S seconds."""
    files = list(folder.glob(f"node-{camera or '*'}.json"))
    return bool(files) and time.time() - max(file.stat().st_mtime for file in files) < FRESH_S


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--serving", metavar="HOST:PORT", help="check that the gRPC health service here is SERVING")
    which.add_argument("--node", type=Path, metavar="DIR", help="check the status file of camera node $CAMERA in DIR")
    add_arguments(parser)
    args = parser.parse_args()
    healthy = (
        is_serving(args.serving, timeout_s=HEALTH_ANSWER_S, transport=from_arguments(args))
        if args.serving
        else is_fresh(args.node, os.environ.get("CAMERA"))
    )
    return 0 if healthy else 1


if __name__ == "__main__":
    sys.exit(main())
