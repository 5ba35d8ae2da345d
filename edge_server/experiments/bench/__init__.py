"""``edge-server bench``: measurements on this machine, one file per part."""
