"""Experiments with camera node, emulator and edge together: virtual deployments, benches, studies, training.
No live code imports this package."""

from freshfield import payload as payload  # sets OpenCV's size limit before what reads data sets imports cv2
