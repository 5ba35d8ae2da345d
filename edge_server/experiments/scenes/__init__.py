"""Input of experiments: multi-view stills and sequences, synthetic or recorded, with their truth."""
