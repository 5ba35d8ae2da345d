"""Recorded data sets: one reader module a format, for streaming by camera nodes or for reading offline."""

from freshfield import payload as payload  # sets OpenCV's size limit before a reader imports cv2
