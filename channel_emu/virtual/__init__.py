"""The same links in virtual time, and what their accuracy costs."""
