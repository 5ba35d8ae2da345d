"""What a running edge writes and serves: run files, recordings, metrics."""
