"""Estimates a channel from a recording."""
