"""What is shown at random instants of synthetic scenes, and where the decibels go. In virtual time."""

from edge_server.experiments.bench.shown.output import draw, table
from edge_server.experiments.bench.shown.runs import measure

__all__ = ["draw", "measure", "table"]
