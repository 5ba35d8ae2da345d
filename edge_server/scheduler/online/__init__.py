"""A learned policy that keeps learning while it is used."""
