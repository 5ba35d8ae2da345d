"""A whole deployment in virtual time."""
