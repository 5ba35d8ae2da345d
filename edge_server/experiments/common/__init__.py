"""Code shared by benches, studies and trainings: stored results, statistics, progress, machine speed."""
