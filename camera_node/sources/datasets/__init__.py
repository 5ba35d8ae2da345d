"""Recorded data sets: one reader a format, streamed by live cameras or read offline."""
