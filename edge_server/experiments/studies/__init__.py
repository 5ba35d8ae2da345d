"""Studies: the thesis's figures and a few it does not have, as commands with verdicts.

A study (``study.Study``) defines points, each a ``trial.Trial``. ``engine`` runs the trials without stored
results; ``statistics`` compares seeds. A new study needs one class file and a line in ``command.STUDIES``.
"""

from __future__ import annotations

from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """``edge-server study``; returns its exit status."""
    from edge_server.experiments.studies.command import main as run

    return run(argv)
