"""Depth images of data sets, and the formats of hand-held depth cameras: a reader each."""

FORMATS = ("tum", "sevenscenes", "record3d", "polycam", "foxglove", "rosbag")
