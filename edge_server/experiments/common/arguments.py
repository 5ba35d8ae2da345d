"""Arguments that the commands of experiments share."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from edge_server.experiments.common.folders import Folders, folders_from
from freshfield.machine_load import usable_cores
from freshfield.untrusted import UntrustedError, read_yaml


class OptionError(ValueError):
    """An option that cannot work; the message says what to change."""


def add_folders(parser: argparse.ArgumentParser) -> None:
    """Add ``--data`` and ``--lpips``, which ``folders_of`` reads."""
    add = parser.add_argument
    add("--data", type=Path, metavar="DIR", help="folder of recorded data sets [$FRESHFIELD_DATA]")
    add_lpips(parser)


def add_lpips(parser: argparse.ArgumentParser) -> None:
    """Add ``--lpips``, which ``weights_folder`` reads."""
    parser.add_argument(
        "--lpips",
        type=Path,
        metavar="DIR",
        help="folder of LPIPS weights [$FRESHFIELD_LPIPS, else lpips/ in the data folder]",
    )


def folders_of(args: argparse.Namespace) -> Folders:
    """The folders of ``--data`` and ``--lpips``, or those that the environment names."""
    return folders_from(args.data, args.lpips)


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add ``--jobs`` and ``--ray``, as in ``Engine``."""
    add = parser.add_argument
    add("--jobs", type=int, default=usable_cores(), metavar="N", help="number of worker processes [%(default)s]")
    add("--ray", metavar="ADDRESS", help="run on a Ray cluster instead: auto, local, or host:port")


def at_least(least: int) -> Callable[[str], int]:
    """Argparse type: a whole number of at least ``least``."""

    def read(text: str) -> int:
        if not text.isdigit() or int(text) < least:
            raise argparse.ArgumentTypeError(f"{text!r}: expected a whole number from {least}")
        return int(text)

    return read


def check_seconds(seconds: float) -> None:
    """OptionError for a time that no run or fit can take."""
    if not 0.0 < seconds <= 1e6:
        raise OptionError(f"--seconds {seconds:g}: expected more than 0 and at most 1e6")


def parse_options(words: Sequence[str]) -> dict[str, Any]:
    """Parse words ``KEY=VALUE`` to options of a field; values are YAML (8, 0.5, true, [0, 0, 1], white).
    Raises OptionError."""
    options: dict[str, Any] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not key or not equals:
            raise OptionError(f"--option {word}: expected KEY=VALUE")
        try:
            options[key] = read_yaml(value)
        except UntrustedError:
            raise OptionError(f"--option {word}: {value!r} is not a value") from None
    return options
