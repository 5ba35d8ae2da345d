"""Keeps a learned policy learning while it is used."""
