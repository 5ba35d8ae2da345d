"""Code shared by the experiments: arguments of commands, folders, statistics and tables."""
