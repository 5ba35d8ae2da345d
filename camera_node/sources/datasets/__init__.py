"""Recorded data sets: one reader module a format, for streaming by camera nodes or for reading offline."""
