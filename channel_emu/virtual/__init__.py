"""The same links simulated in virtual time, and the replay of a trace."""
