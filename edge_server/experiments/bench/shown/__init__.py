"""Measures, in virtual time, the images shown at random instants of synthetic scenes, and the causes of their
errors."""

from edge_server.experiments.bench.shown.output import draw, table
from edge_server.experiments.bench.shown.runs import measure

__all__ = ["draw", "measure", "table"]
