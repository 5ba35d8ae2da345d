"""Numbers of recorded data sets and of real cameras."""

# --- photos (held_out_captures) ---
HOLD_OUT_EVERY = 8  # of so many photos the first is held out, where the data set has no test images of its own

# --- sizes of images (datasets.photo, datasets.dynerf, datasets.rgbd.depth_file, datasets.image_reading) ---
# Tolerated difference of aspect ratio between an image and what it was calibrated as: both are in whole pixels.
SAME_SHAPE = 0.02
SAME_DEPTH_SHAPE = 0.05  # the same tolerance of depth and the image it is registered to
# Bytes read first of an image: they hold the size of nearly every JPEG, behind its EXIF data and thumbnail.
HEADER_BYTES = 2**18

# --- undistorted images (datasets.lens) ---
WIDEST_DEG = 60.0  # widest angle from the axis of an undistorted image; beyond it the corners are mostly stretched
# Focal lengths that are tried for an undistorted image: multiples of the lens's own, narrowest view first.
ZOOM_FROM, ZOOM_STEP, ZOOM_STEPS = 4.0, 0.98, 180
# Points a side, and from the middle to a corner, that tell whether an undistorted image lies within the original.
BORDER_POINTS = 65

# --- sequences of TUM RGB-D (datasets.rgbd.tum) ---
TUM_NEAR_NS = 20_000_000  # largest gap from an image of a TUM RGB-D sequence to its pose, and to its depth

# --- videos (datasets.video) ---
VIDEO_FPS = 30.0  # rate of a video whose file does not tell
EVEN_PERIODS = 0.1  # a video whose stamps are off by less than this share of a period keeps to its rate
# Of another, times between frames within this share of the median count for its rate: others are gaps.
SAME_PERIOD = 0.5
SKIP_FRAMES = 30  # up to this distance, decoding forward is cheaper than seeking, which decodes from a key frame
BLOCK_FRAMES = 12  # videos decode only forwards: to play backwards, this many (shrunk) frames are decoded at once
# So many of the last frames tell whether a video ends where its packets do; more, where stamps are so uneven that
# OpenCV, which seeks by the mean rate, finds none.
ENDING_FRAMES = (4, SKIP_FRAMES)

# --- recorded bags (datasets.rgbd.recorded_messages) ---
# Time within which an image of a recorded bag gets a depth image: less than half a period of 15 images a second.
RECORDING_DEPTH_NEAR_NS = 20_000_000
# Largest gap from such an image to a sample of its frame's own transform: half a period of 10 samples a second.
RECORDING_POSE_NEAR_NS = 50_000_000
# The same of the transforms above: robots correct map -> odom only some times a second, and by little.
RECORDING_PARENTS_NEAR_NS = 250_000_000

# --- cameras (devices.live) ---
# Pauses before a camera that failed is opened again: after the first failure, the second, ...
REOPEN_AFTER_S = (0.25, 0.5, 1.0, 2.0, 5.0)
# Longest wait of a capture for a new frame: seconds, and share of the time between two captures.
NEXT_FRAME_S, NEXT_FRAME_PERIODS = 0.5, 0.5
GRAB_S = 0.5  # a thread waits so long for a frame until it looks whether it is to end
CAMERA_JOIN_S = 2.0  # time for such a thread to end

# --- cameras by maker (devices.opencv, devices.oak, devices.realsense) ---
OPEN_MS, READ_MS = 2500, 2000  # longest wait of OpenCV for a network camera to answer, and for its next frame
# A stamp on the machine's monotonic clock is younger than this; otherwise it is from another clock.
PLAUSIBLE_NS = 1_000_000_000
OAK_SEARCH_MS = 2000  # longest search of depthai for its cameras, by default 11.5 s
LONGEST_EXPOSURE_US = 200_000  # believed of a RealSense camera: the color sensors of the series expose at most 165 ms
