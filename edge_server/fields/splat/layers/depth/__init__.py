"""What cameras that measure depth add to the layers: imported once a frame brings depth."""
