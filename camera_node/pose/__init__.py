"""Camera poses: fixed, recorded, or paired with a stream of pose samples."""
