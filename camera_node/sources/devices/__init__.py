"""Real cameras: OpenCV, Luxonis OAK, Intel RealSense."""
