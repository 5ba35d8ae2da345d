"""``edge-server frontier``: what fidelity costs in time."""
