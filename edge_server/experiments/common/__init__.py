"""What benches, studies and trainings share: stored results, progress, machine load."""
