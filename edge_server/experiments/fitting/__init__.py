"""``edge-server fit``: fields fitted to recorded data without a network."""
