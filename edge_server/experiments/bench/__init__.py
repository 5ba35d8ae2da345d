"""``edge-server bench``: measurements of this machine, one part a file."""
