"""Input data of experiments: multi-view stills and sequences, synthetic or recorded, with their true
images."""
