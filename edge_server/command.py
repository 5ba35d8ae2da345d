"""How a command of ``edge-server`` begins and ends: its parser, its errors in one line, Ctrl-C."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable


def command_parser(prog: str, description: str) -> argparse.ArgumentParser:
    """The parser of a command, such as ``edge-server fit``, which prints ``description`` as it stands."""
    raw = argparse.RawDescriptionHelpFormatter
    return argparse.ArgumentParser(prog, description=description, formatter_class=raw)


def exit_status(
    prog: str,
    work: Callable[[], object],
    errors: type[Exception] | tuple[type[Exception], ...],
    stopped: str | None = None,
) -> int:
    """Call ``work`` and return the exit status of the command.

    errors: exceptions that are printed in one line; the status is then 2.
    stopped: text that is printed after Ctrl-C, unless the KeyboardInterrupt has one of its own; the status is then
        130. None: KeyboardInterrupt is raised on.
    """
    try:
        work()
    except errors as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        if stopped is None:
            raise
        print(f"\nstopped; {str(interrupt) or stopped}", flush=True)
        return 130
    return 0
