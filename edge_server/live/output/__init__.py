"""What a running edge leaves and shows: run files, recordings, decisions, metrics."""
