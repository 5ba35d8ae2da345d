"""Instant-NGP style hash grid (Mueller et al. 2022)."""
