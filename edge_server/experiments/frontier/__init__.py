"""``edge-server frontier``: what accuracy costs in time."""
