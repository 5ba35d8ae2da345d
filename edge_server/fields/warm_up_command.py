"""``edge-server warm-up``: compiles kernels before the first run needs them.

It imports no more than the fields do, so that ``make`` can run it while everything else is being installed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from edge_server.fields.compiling import USUAL
from edge_server.fields.registry import FIELD, field_names, make_field

DESCRIPTION = f"""\
Compile the kernels of a field for this processor ({USUAL}),
so that the first run starts at once. Later starts load them. Run it again on another kind of processor, or after an
update.

  freshfield warm-up             the default field, for cameras that stand still and for carried ones
  freshfield warm-up quad        only what this scenario uses
"""

WARMED: Mapping[str, tuple[Mapping[str, Any], ...]] = {
    "splat": ({"layers": True}, {"scan": True, "refine": True, "carried": True})
}
"""Options of the fields that ``warm_up`` runs for a representation, where its defaults do not use all kernels: fixed
cameras, and a carried one."""


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("freshfield warm-up", description=DESCRIPTION, formatter_class=raw)
    parser.add_argument("scenario", nargs="?", help="scenario file, or the name of a shipped one: its field alone")
    parser.add_argument("--field", choices=field_names(), help="without a scenario [the default field]")
    args = parser.parse_args(argv)
    if args.scenario is not None:
        field, seconds = _of_scenario(args.scenario)
    else:
        field = args.field or FIELD
        seconds = warm_up(field)
    print(f"kernels of {field} ready after {seconds:.1f} s")
    return 0


def _of_scenario(name: str) -> tuple[str, float]:
    """The field of a scenario, and the seconds that its kernels took. Raises ScenarioError."""
    from edge_server.settings import read_config
    from freshfield.scenario import ScenarioError, load

    scenario = load(name)
    config = read_config(scenario)
    try:
        return config.field, warm_up(config.field, config.field_options, len(scenario.training))
    except ValueError as error:
        raise ScenarioError(f"{scenario.path}: {error}") from None


def warm_up(field: str, options: Mapping[str, Any] | None = None, cameras: int = 1) -> float:
    """Compile a representation's kernels, or load them; returns the seconds taken.

    field: one of ``registry.field_names``. options: its options; None: every kind that scenarios use (``WARMED``).
    cameras: how many there will be, see ``fields.Field.warm_up``.
    Raises ValueError as ``registry.make_field``.
    """
    kinds = WARMED.get(field, ({},)) if options is None else (options,)
    return sum(make_field(field, kind).warm_up(cameras) for kind in kinds)


if __name__ == "__main__":
    sys.exit(main())
