"""``edge-server bench peer``: compares our fields with other programs. To add a peer, add a file here and a
line in ``race``."""

from edge_server.experiments.bench.peer.race import measure, table

__all__ = ["measure", "table"]
