"""``edge-server bench peer``: the race is in ``race``; a peer is one file and one line there."""

from edge_server.experiments.bench.peer.race import measure, table

__all__ = ["measure", "table"]
