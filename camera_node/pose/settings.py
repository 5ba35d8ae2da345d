"""Numbers of the poses of a tracker that runs beside a camera."""

TRACKER_LOOKS_S = 0.005  # how often for lines: a quarter of the 20 ms between poses of a usual tracker
TRACKER_LATE_S = 0.1  # a frame waits so long for its pose: trackers take 20 to 60 ms, and captures are 67 ms apart
TRACKER_LINE_BYTES = 4096  # read at once, compared again later, and longest line that is kept: one has some 100
