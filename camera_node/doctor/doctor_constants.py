"""Numbers of what the doctor says."""

# --- the disk, the edge and the cameras (doctor_command) ---
LEAST_FREE_GB = 2.0  # on the disk of the output folder
EXCHANGES = 8  # clock exchanges with the edge, which tell the offset of the clocks
ANSWER_S = 2.0  # longest wait for the edge to accept a connection, and to answer an exchange
LISTEN_S = 1.0  # how long the doctor listens to a camera; in half of it, one late frame changes the rate by a third
LISTEN_AT_MOST_S = 3.0  # the same of a slow camera
JUDGED_FRAMES = 5  # least number of expected frames for judging the rate; with fewer, chance decides
LEAST_RATE = 0.6  # least share of the frame rate asked for

# --- the arm (arm_check) ---
ARM_LISTEN_S = 0.5  # for which joint states are counted
ARM_LEAST_STATES = 0.8  # share of the joint states asked for; with fewer, the network or the machine is busy
ARM_LEAST_REACHED = 0.6  # share of a tour's viewpoints; with fewer, a side of the target stays unseen

# --- what fixed cameras see (coverage_check) ---
COVERAGE_TICKS = (0, 7, 30)  # ticks whose shots tell whether a camera moves that never repeats one

# --- a camera's depth (depth_check) ---
DEPTH_QUANTILES = (0.05, 0.5, 0.95)  # the first and the last are said, the middle one tells whether the unit is wrong
# Most points of a camera that are looked for: the share that agrees is then known to a percent.
DEPTH_MOST_POINTS = 4000
DEPTH_FEWEST_POINTS, DEPTH_FEWEST_EDGES = 100, 200  # points, and pixels at edges, of which anything is said
DEPTH_SAME = 0.05  # relative difference of depths of one surface: the errors of sensors and poses are 1 to 2 %
DEPTH_AGREES = 0.75  # least share of points that agree; measured: 0.86 to 1 where depth is right
DEPTH_OVERLAPS = 0.2  # least share, of the points in each other's image, that another unit has to make agree
DEPTH_FACTORS = (1e-3, 1e-2, 0.1, 0.3048, 1 / 0.3048, 10.0, 100.0, 1e3)  # of mistaken units: mm, cm, dm, feet
DEPTH_CONSTANT = 0.95  # most share of one number among those measured
DEPTH_LEAST_MEASURED = 0.02  # least share of the pixels that have a depth
DEPTH_JUMP = 0.1  # least change of inverse depth between neighbors, relative to the nearer one: an edge
DEPTH_BESIDE = 0.06  # distance from edges to where the image is compared with them, of its width
# Least contrast of the image at edges of depth, over that beside them. Measured: 1.16 to 2.2 in the room, the
# path-traced kitchen and a Kinect's recording; with another camera's depth 0.74 to 1.14, mostly below 1.05.
DEPTH_LEAST_CONTRAST = 1.05

# --- do a carried camera's poses move as its images do? (pose_check) ---
POSES_CAPTURES, POSES_LEAST_CAPTURES = 100, 20  # captures that are compared; fewer shifts correlate by chance
POSES_WIDTH_PX = 80  # of the compared images: enough for shifts of a tenth of a pixel, and 0.3 s for all of them
POSES_LARGEST_LAG, POSES_LAG_STEP = 4, 0.25  # captures by which poses are tried to be late or early
POSES_MOVE_PX = 0.1  # standard deviation of shifts below which nothing can be told from them
# Right poses of redkitchen and handheld correlate by .90 and .97; late by 100 ms they gain .05 and more at their lag.
POSES_AGREE, POSES_GAIN = 0.7, 0.03
POSES_LATE_MS = 60.0  # least delay that is said: what is found is off by up to 25
POSES_FAST_M_PER_S = 10.0  # nobody carries a camera so fast: another unit
