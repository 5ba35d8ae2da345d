"""Entry points of the installed commands: how each of them ends at Ctrl-C, or when nobody reads its output.

This file imports nothing of the commands until Ctrl-C is harmless, so it knows their modules by name only.
"""

from __future__ import annotations

import os
import signal
import sys

INTERRUPTED = 128 + signal.SIGINT
"""Exit status after Ctrl-C, as shells report it."""
NOBODY_READS = 128 + signal.SIGPIPE
"""Exit status after the reader of the output has gone (``channel-emu presets | head -1``)."""


def run(module: str) -> int:
    """Import a command's module and run its ``main``. Returns the exit status."""
    if catches := signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        # Within an import Ctrl-C would print a traceback; the default action just ends the process.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    import importlib  # only now: it takes a while itself

    main = importlib.import_module(module).main
    if catches:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        try:
            return int(main())
        finally:
            if sys.stdout is not None:  # it was closed by the caller
                sys.stdout.flush()
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        discard_output()
        return NOBODY_READS


def discard_output() -> None:
    """Drop what is printed from now on. Else Python reports at exit that it could not write the rest."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def camera_node() -> int:
    return run("camera_node.cli")


def channel_emu() -> int:
    return run("channel_emu.cli")


def edge_server() -> int:
    return run("edge_server.cli")


def freshfield() -> int:
    return run("freshfield_up.cli")
