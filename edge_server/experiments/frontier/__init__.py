"""``edge-server frontier``: measures fidelity against computing time."""
