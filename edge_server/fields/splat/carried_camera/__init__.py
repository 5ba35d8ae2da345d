"""Gaussians of a scan: many views, usually from one moving camera, of a static scene."""
