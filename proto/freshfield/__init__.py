"""Code shared by all processes: wire format, geometry, scenario, files and limits; nothing else."""

__version__ = "0.1.0"
