"""Synthetic scenes, one file each."""
