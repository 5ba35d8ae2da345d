"""freshfield's contract: what two processes must agree on, and nothing else."""

__version__ = "0.1.0"
