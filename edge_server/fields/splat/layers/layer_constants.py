"""Constants of the layers, tuned once on our scenes. None is an option."""

from __future__ import annotations

# --- start of the layers (layered_field, static_layer, static_supervision, motion_tracker, depth.depth_supervision) ---
LEAST_CAMERAS = 2  # fewest cameras for layers: one alone gives no depth, and the still field learns its frames
PLATE_FRAMES, PLATE_S = 8, 3.2  # frames of each camera, and time since the first, before plates are certain
# Time since the first frame at which layers start, with the pixels of the plates known by then: nine tenths in `room`.
# At PLATE_S the still field restarts.
EARLY_S = 1.0
# If the still field learns in another thread, it restarts only after EARLY_STEPS steps, or at PLATES_SURE_S: two cores
# make 330 steps by PLATE_S with 12 cameras, and a field restarted then was worse than the one shown until 8 s.
EARLY_STEPS, PLATES_SURE_S = 600, 6.0
PLATES_EVERY_S = 0.5  # how often plates are compared with what the still field has learned
EVIDENCE_S = 0.8  # largest age of a frame from which motion is estimated
RENDERINGS_A_FIT = 2  # renderings of the still field that plates adopt per fit
# Steps after which the still field that began early is shown: what it replaces has learned what moves as background.
EARLY_SHOWN_AFTER = 200
SHOWN_AFTER = 400  # steps after which a restarted still field is shown if there is nothing to compare it with
# Otherwise it is shown once it fits the plates as well as the field that it replaces, or after the first's number of
# steps; the second is the weight of a step in the running mean of its error.
SHOWN_AT_LATEST, ERROR_RATE = 1200, 0.06

# --- frames and cameras that are taken in (layered_field, layered_state, observations, snapshot, page.splats) ---
MOST_PIXELS = 400_000  # of one image of every camera together, if 15 frames a second of each are taken in
LEAST_SHARE = 0.01  # least share of an image that counts as moving: among calmer cameras, a frame's age decides
FRAMES_KNOWN = 256  # capture times of earlier frames that are remembered per camera
MOST_MOVES = 3  # number of places of a camera above which it counts as moving
STANDS_FRAMES = 60  # frames from one place after which earlier moves are forgotten
MAX_AHEAD_S = 0.3  # seconds by which motion is extrapolated at most: people turn

# --- plates at full resolution, where frames are taken in at a lower one (plates, static_supervision) ---
# Frames that one update takes in at full resolution (1.4 ms each) until all fine plates are known. With one frame, they
# are known after 3 s instead of 1.5, and `kitchen` shows 4 dB less meanwhile.
FIRST_FINE = 4
FIRST_FINE_EVERY_S, FINE_EVERY_S = 0.01, 0.05  # least time to the next such frame, until then and afterwards
FINE_FRAMES = 4  # frames of each camera before the still field learns from fine plates
FINE_MEMORY, FINE_KNOWN = 16, 3  # frames that a fine plate is the mean of; fewest that make it known

# --- exposures (equal_exposures, plates, static_supervision, kernels.plates, depth.overlaps) ---
EXPOSURE_ROUNDS, EXPOSURE_STEPS = 6, 25  # fits in which cameras agree on an exposure, and steps of each
EXPOSURES_AGREE = 0.02  # standard deviation of log exposures over the cameras, up to which they agree
EXPOSURE_RATE = 1.6  # factor on a correction: after so few steps some six tenths of a difference show
GAIN_STEP = 0.01  # relative change of exposure; smaller ones are left to the running mean
GAIN_MOST = 3.0  # largest change of exposure between two frames, as a factor
GAIN_SHARE = 0.03  # share of the pixels that must be usable to estimate a change of exposure
COMMON_SHARE = 0.25  # as GAIN_SHARE, between cameras: only the edges of overexposed areas are usable, and mislead
DARK, BRIGHT = 20.0, 235.0  # of 255: only colors between these are used to estimate exposures

# --- the still field's training on plates (static_layer, depth.plate_stereo) ---
SCHEDULE = 1600  # steps of the first schedule, in which the field grows
ROUND = 10  # steps of a round, over which rates fall; its parameters enter the mean
ROUNDS_FIRST, RATE_FIRST = 60, 0.05  # rounds after the schedule; least weight of a round in the mean
ROUNDS_AGAIN, RATE_AGAIN = 20, 0.1  # the same after plates have changed
CHANGED = 8.0  # of 255, after blurring: a plate that differs more from the learned one has changed
CHANGED_PIXELS = 40  # changed pixels of a camera, above which the field is trained again
RENDER_EVERY = 400  # steps between renderings of all cameras while training in a separate thread

# --- a pixel's plate: colors in steps of 255 (plates, kernels.masks, kernels.plates) ---
THRESHOLD = 10.0  # colors this near are the same mode
THRESHOLD_UNKNOWN = 20.0  # foreground differs by more from the still field, where no plate is known
DEVIATIONS = 3.5  # foreground also differs from the plate by this many of the pixel's own mean deviations
DEVIATION_RATE = 0.05  # weight of a frame in that mean
DEVIATION_MOST = 3.0  # times the foreground threshold: larger differences do not enter the pixel's deviation
LAGS = (2, 5)  # frames back with which a frame is compared: a pixel that changes does not vote
MEMORY = 60  # arrivals over which votes decay
SLOWEST_RATE = 1.0 / 24.0  # least weight of a new frame in a mode's running mean
RUN = 12  # arrivals in a row that join another mode: it becomes the plate
# A plate is known with this many votes and this share of all arrivals; after fewer arrivals, with EARLY_SHARE of them.
KNOWN_VOTES, KNOWN_SHARE, EARLY_SHARE = 8.0, 0.3, 0.9
LEAST_WEIGHT = 0.05  # votes, below which a mode is forgotten
SPECK, HOLE = 10, 0.02  # smaller specks of a mask, pixels, are removed; holes up to that share of the image filled
REFUSED_SHARE = 0.6  # of the pixels: a frame with more foreground shows another scene than the plate
# The moving set explains a frame where its opacity is more than the first and its worst channel is off by less than the
# second.
HELD_OPACITY, HELD_ERROR = 0.5, 0.12

# --- a camera that was bumped (bump, observations) ---
BUMP_SIDES_PX = (32, 64, 128)  # of the images that are aligned, one after the other: a turn of some pixels of the first
# Foreground, as a share of the pixels and in multiples of the usual one, below which no turn is searched for.
BUMP_SHARE, BUMP_UNUSUAL = 0.1, 2.0
BUMP_FRAMES, BUMP_AGREE_DEG = 3, 0.3  # frames in a row with the same turn, and tolerance: the camera no longer swings
BUMP_EVERY_S = 0.2  # time between two searches for a turn, until a frame has one
BUMP_BLUR_PX = 1.0  # blur of the images that are aligned, against noise
BUMP_ROUNDS = 10  # rounds of Gauss-Newton at each size
BUMP_NEAR = 8.0  # of 255: pixels that differ by more do not match the plate
# A turn is accepted if it makes this share of the pixels match the plate (BUMP_GAINS) and leaves at most this share of
# the mismatched pixels (BUMP_LEAVES).
BUMP_GAINS, BUMP_LEAVES = 0.05, 0.6
BUMP_LEAST_DEG, BUMP_MOST_DEG = 0.3, 12.0  # of a turn: calibration errs by less; more shows another view

# --- how much a pixel counts (observations) ---
NEAR_FOREGROUND_PX = 5  # width of the square by which the foreground is dilated; pixels within it have full weight
BACKGROUND_WEIGHT = 0.5  # weight of the other pixels
OCCLUDED_M = 0.15  # pixels have no weight where the still field is nearer than the moving set by this much

# --- the moving set (layered_field, moving_set, motion_tracker) ---
GAUSSIANS, ANCHORS = 1500, 24  # for a foreground of USUAL_SHARE of the pixels
USUAL_SHARE = 0.062  # usual share of foreground pixels
# The capacity follows the foreground, in multiples of USUAL_SHARE: up at once, to the first at most; down by the second
# as a factor each time.
MOST_FOREGROUND, FOREGROUND_DECAY = 2.5, 0.998
GAUSSIANS_SLOWER = 3.0  # factor by which the number of Gaussians grows more slowly than the foreground
LEAST_ALIVE = 16  # Gaussians, below which nothing is aligned
GAUSSIANS_AN_ANCHOR = 8  # least number of Gaussians per anchor
DENSIFY_EVERY = 80  # steps between densifications (of the still field: the option ``densify_every``)
STEP_PROGRESS = 0.3  # progress of a fit at which its learning rates are taken
# Seeding, at an instant that most cameras have seen: share of the cameras that must have seen it (the second if
# none has the first), and the latest knots among which it is looked for.
CAMERA_SHARES, SEEDING_KNOTS = (0.58, 0.42), 7
LEAST_FOREGROUND = 0.001  # share of all pixels, from which on the foreground is seeded
KEEP_INSIDE, KEEP_DILATION_PX = 0.6, 5  # share of the foregrounds, grown, in which a Gaussian must lie
LOST_BELOW = 0.5  # share of Gaussians inside the foregrounds below which tracking is lost
SEED_INSIDE, SEED_DILATION_PX = 0.7, 3  # as KEEP_INSIDE and KEEP_DILATION_PX, for a new Gaussian
MISSING_ERROR = 0.12  # color error, in the worst channel, above which foreground needs new Gaussians
SEEDS_A_PIXEL = 0.1  # new Gaussians for each pixel that needs them
FEW = 32  # Gaussians, below which all foreground needs new ones

# --- few cameras (layered_field, moving_set, plates, static_supervision, motion_tracker, depth.depth_supervision) ---
# With up to four views motion is less constrained: it gets a tighter prior, more anchors, and earlier seeding.
# Accelerations and speeds are at most the cameras' distance to the scene per second squared and per second: objects
# seen from near are small and slow.
FEW_CAMERAS = 4
STEREO_CAMERAS = 10  # cameras up to which stereo of plates helps (`room`: 2.4 dB with 10 cameras, -.3 with 12)
# Untextured walls and ceilings give no depth from color. If the untextured share of the plates (changes below
# PLAIN_STEPS of 255 within PLAIN_PX pixels) is within PLAIN_SHARE, stereo helps up to PLAIN_CAMERAS: rooms drawn from
# seeds gain up to 6 dB. A larger share is the backdrop of an object: `tile` loses 1.3.
PLAIN_CAMERAS, PLAIN_SHARE, PLAIN_STEPS, PLAIN_PX = 12, (0.04, 0.25), 2.0, 9
# As ANCHORS, ACCELERATION_M_PER_S2, NEIGHBOR_M_PER_S and SEED_EVERY_S, for few cameras:
FEW_ANCHORS, FEW_ACCELERATION_M_PER_S2, FEW_NEIGHBOR_M_PER_S, FEW_SEED_EVERY_S = 32, 3.0, 3.0, 0.07
# Steps of appearance for each stride, where a frame has more pixels than the second: with STEPS, updates of the
# recorded kitchen before four cameras take 4 ms longer and show less (few-cameras.json).
FEW_STEPS, FEW_STEPS_PIXELS = 6, 20_000
FEW_MOST_ANCHORS = 48  # anchors at most, however large the foreground: the time of an update grows with their square

# --- motion tracking (motion_tracker) ---
# Most Gauss-Newton passes over a stride, and the median movement of anchors that requires another pass.
PASSES, AGAIN_M = 3, 0.02
ALIGNING_SHARE = 0.5  # largest share of a budget in seconds that alignment may take
STRIDE_S = 0.08  # longest time span tracked at once: motion over a longer one leaves the basin of the alignment
LEAST_ALIGNED, MOST_ALIGNED = 4, 24  # frames in a pass, newest first; at least, however short the budget, and at most
STEPS = 10  # most steps of appearance for each stride
SEED_EVERY_S = 0.2  # time between seedings
SEED_AT_LEAST_EVERY_S = 0.6  # longest time between seedings, even beyond the budget
ANCHORS_EVERY_S = 1.0  # time between selections of new anchors

# --- motion (motion, moving_set, observations, motion_tracker, kernels.align, page.splats.published) ---
KNOTS_PER_S = 15  # knots a second at which displacements are solved for
FREE, FIXED = 10, 3  # knots solved for, and older ones before them
PERSISTENCE = 0.9  # share of the acceleration that is kept from knot to knot
ACCELERATION_M_PER_S2 = 5.0  # deviation from that acceleration
NEIGHBORS, NEIGHBOR_M_PER_S = 4, 2.0  # neighbors of an anchor that move alike; deviation of their speeds
ATTACHED = 3  # anchors that a Gaussian follows
CLUSTER_OPACITY = 0.5  # opacity above which Gaussians have equal weight in choosing anchors; below, their opacity
CLUSTER_ROUNDS = 3  # rounds of k-means
LEAST_REACH, FIRST_REACH = 1e-2, 0.3  # scene units from an anchor to the next: at least; of one alone

# --- least squares of the motion (kernels.align, kernels.solve) ---
NOISE = 0.2  # of full scale: standard deviation of a pixel's error in the least squares
ROBUST = 1.0  # scale of Cauchy's weights 1 / (1 + e^2 / ROBUST^2)
MOST_ITERATIONS = 60  # iterations of conjugate gradients at most
# The iteration ends when the estimated distance to the solution, over all unknowns together, is this many of its
# standard deviations.
TOLERANCE = 0.02
