"""What the processes must agree on: wire format, geometry, scenario, files, limits; and nothing else."""

__version__ = "0.1.0"
