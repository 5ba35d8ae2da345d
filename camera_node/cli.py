"""The entry point of ``camera-node``, which imports nothing until Ctrl-C is harmless."""

from __future__ import annotations

import signal
import sys


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit status."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:
        # Within an import Ctrl-C would print a traceback; the default action just ends the process.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from camera_node import command_line

    signal.signal(signal.SIGINT, before)
    try:
        return command_line.run(arguments)
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
