"""Gaussians of a scan: many views, usually of one moving camera, of a scene that stands still."""
