"""Studies: the thesis's figures and a few it does not have, as commands with verdicts.

A study names its points (``base.Study``), each a ``trial.Trial``; ``engine`` runs what is not known yet;
``statistics`` says what the seeds tell. Adding a study is one file with a class and a line in
``command.STUDIES``.
"""

from __future__ import annotations

from collections.abc import Sequence


def main(argv: Sequence[str] | None = None) -> int:
    """``edge-server study``; returns its exit status."""
    from edge_server.experiments.studies.command import main as run

    return run(argv)
