"""Numbers of the layers, tuned once on our scenes. None is an option."""

from __future__ import annotations

# --- when what begins (layered_field, static_layer) ---
LEAST_CAMERAS = 2  # one alone gives no depth: the still field learns its frames
PLATE_FRAMES, PLATE_S = 8, 3.2  # frames of each camera, and time since the first, before plates are certain
# Layers begin with what is known of the plates then: nine tenths in `room`. At PLATE_S the still field begins anew.
EARLY_S = 1.0
# Where it learns in a thread beside, not before it has had so many steps, or at PLATES_SURE_S: two cores make 330 by
# PLATE_S with 12 cameras, and what began anew then was worse than what was shown until 8 s.
EARLY_STEPS, PLATES_SURE_S = 600, 6.0
PLATES_EVERY_S = 0.5  # how often plates are compared with what the still field has learned
EVIDENCE_S = 0.8  # largest age of a frame from which motion is estimated
RENDERINGS_A_FIT = 2  # renderings of the still field that plates take over in a fit
# Steps after which the still field is shown that began early: what it replaces has learned what moves as background.
EARLY_SHOWN_AFTER = 200
SHOWN_AFTER = 400  # steps, after which a still field is shown that began anew without anything to compare it with
# Else it is shown once it fits the plates as well as what it replaces, or has had so many steps; weight of a step in
# the running mean of its error.
SHOWN_AT_LATEST, ERROR_RATE = 1200, 0.06
MOST_PIXELS = 400_000  # of one image of every camera together, if 15 frames a second of each are taken in
LEAST_SHARE = 0.01  # of a picture that counts as moving: which of calmer cameras is taken in, a frame's age decides
FRAMES_KNOWN = 256  # instants of earlier frames that are remembered for each camera
SAME_POSE = 1e-3  # largest difference of poses of one place, meters and entries of the rotation
MOST_MOVES = 3  # places from which a camera shows something, above which it moves
STANDS_FRAMES = 60  # frames from one place, after which earlier moves are forgotten
MAX_AHEAD_S = 0.3  # motion is extrapolated no farther than this: people turn

# --- plates at full resolution, where frames are taken in at a lower one ---
# Frames that one update takes in at their full resolution (1.4 ms each), before all plates are known in it. With one,
# they are known after 3 s instead of 1.5, and `kitchen` shows 4 dB less meanwhile. Least time to the next, then and
# afterwards.
FIRST_FINE = 4
FIRST_FINE_EVERY_S, FINE_EVERY_S = 0.01, 0.05
FINE_FRAMES = 4  # frames of each camera before the still field learns from fine plates
FINE_MEMORY, FINE_KNOWN = 16, 3  # frames that a fine plate is the mean of; fewest that make it known

# --- exposures ---
EXPOSURE_ROUNDS, EXPOSURE_STEPS = 6, 25  # fits in which cameras agree on an exposure, and steps of each
EXPOSURES_AGREE = 0.02  # standard deviation of log exposures over the cameras
EXPOSURE_RATE = 1.6  # factor on a correction: after so few steps some six tenths of a difference show
GAIN_STEP = 0.01  # smaller changes of exposure are left to the running mean
GAIN_MOST = 3.0  # largest change of exposure between two frames
GAIN_SHARE = 0.03  # share of the pixels that must be usable to estimate a change of exposure
COMMON_SHARE = 0.25  # the same over other cameras: of overexposed areas only edges are usable, and these mislead
DARK, BRIGHT = 20.0, 235.0  # only plates between these are used to estimate exposure

# --- the still field's training on plates ---
SCHEDULE = 1600  # steps of the first schedule, in which the field grows
ROUND = 10  # steps of a round, over which rates fall; its parameters enter the mean
ROUNDS_FIRST, RATE_FIRST = 60, 0.05  # after the schedule; least weight of a round in the mean
ROUNDS_AGAIN, RATE_AGAIN = 20, 0.1  # where plates have changed
CHANGED = 8.0  # of 255, after blurring: a plate that differs more from what was learned has changed
CHANGED_PIXELS = 40  # a camera, above which the field is trained again
RENDER_EVERY = 400  # steps of a thread of its own, between renderings of all cameras

# --- a pixel's plate: colors in steps of 255 ---
THRESHOLD = 10.0  # colors this near are the same mode
THRESHOLD_UNKNOWN = 20.0  # where no plate is known, foreground differs by more from the still field
DEVIATIONS = 3.5  # foreground also differs from the plate by this many of the pixel's own mean deviations
DEVIATION_RATE = 0.05
DEVIATION_MOST = 3.0  # times what is foreground: what differs by more tells nothing of the pixel's deviation
LAGS = (2, 5)  # frames back with which a frame is compared: a pixel that changes does not vote
MEMORY = 60  # arrivals over which votes decay
SLOWEST_RATE = 1.0 / 24.0  # least weight of a new frame in a mode's running mean
RUN = 12  # arrivals in a row that join another mode: it becomes the plate
KNOWN_VOTES, KNOWN_SHARE, EARLY_SHARE = 8.0, 0.3, 0.9  # see ``kernels.plates``
LEAST_WEIGHT = 0.05  # a mode of less is forgotten
SPECK, HOLE = 10, 0.02  # pixels, share of the image: see ``kernels.masks``
REFUSED_SHARE = 0.6  # of the pixels: with more foreground, a frame does not show what the plate shows
HELD_OPACITY, HELD_ERROR = 0.5, 0.12  # where the moving set explains a frame

# --- a camera that was bumped (bump) ---
BUMP_SIDES_PX = (32, 64, 128)  # of the images that are aligned, one after the other: a turn of some pixels of the first
BUMP_SHARE, BUMP_UNUSUAL = 0.1, 2.0  # of the pixels, and of the usual foreground: with less no turn is looked for
BUMP_FRAMES, BUMP_AGREE_DEG = 3, 0.3  # frames in a row that tell the same turn: it no longer swings
BUMP_EVERY_S = 0.2  # how often is looked for one, until a frame tells a turn
BUMP_BLUR_PX = 1.0  # of the images that are aligned, against noise
BUMP_ROUNDS = 10  # of Gauss-Newton in each
BUMP_NEAR = 8.0  # of 255: pixels that differ by more do not show what the plate shows
# A turn is believed that has so many more pixels show what the plate shows, and leaves so few of those that did not.
BUMP_GAINS, BUMP_LEAVES = 0.05, 0.6
BUMP_LEAST_DEG, BUMP_MOST_DEG = 0.3, 12.0  # less is below what calibration errs; more shows another view

# --- how much a pixel counts ---
NEAR_FOREGROUND_PX = 5  # width of the square by which the foreground grows, where pixels count in full
BACKGROUND_WEIGHT = 0.5  # weight of the other pixels
OCCLUDED_M = 0.15  # pixels do not count where the still field is nearer than the moving set by this

# --- the moving set ---
GAUSSIANS, ANCHORS = 1500, 24  # for a foreground of USUAL_SHARE of the pixels
USUAL_SHARE = 0.062
MOST_FOREGROUND, FOREGROUND_DECAY = 2.5, 0.998  # see ``MovingSet.follow_foreground``
GAUSSIANS_SLOWER = 3.0  # the number of Gaussians grows so many times as slowly as the foreground
LEAST_ALIVE = 16  # Gaussians, below which nothing is aligned
GAUSSIANS_AN_ANCHOR = 8  # at least
DENSIFY_EVERY = 80  # steps; of the still field: the option ``densify_every``
STEP_PROGRESS = 0.3  # progress of a fit at which its learning rates are taken
# Seeding, at an instant that most cameras have seen: share of the cameras that must have seen it (the second if
# none has the first), and the latest knots among which it is looked for.
CAMERA_SHARES, SEEDING_KNOTS = (0.58, 0.42), 7
LEAST_FOREGROUND = 0.001  # share of all pixels
KEEP_INSIDE, KEEP_DILATION_PX = 0.6, 5  # share of the foregrounds, grown, in which a Gaussian must lie
LOST_BELOW = 0.5  # share that lies inside, below which motion is lost
SEED_INSIDE, SEED_DILATION_PX = 0.7, 3  # as KEEP_INSIDE, for a new Gaussian
MISSING_ERROR = 0.12  # color error, in the worst channel, above which foreground needs new Gaussians
SEEDS_A_PIXEL = 0.1
FEW = 32  # Gaussians: all foreground needs new ones below this

# --- few cameras ---
# Up to four views leave more of the motion open: it is bound more tightly, has more anchors, and is seeded sooner.
# Accelerations and speeds are at most the cameras' distance to the scene, a second squared and a second: what is seen
# from near is small and slow.
FEW_CAMERAS = 4
STEREO_CAMERAS = 10  # up to so many, stereo of plates helps (`room`: 2.4 dB with 10 cameras, -.3 with 12)
# Colors of plain walls and ceilings tell no depth. Where such a share of the plates is plain (changes by less than so
# many steps of 255 within so many pixels), stereo helps more cameras: rooms drawn from seeds gain up to 6 dB. A larger
# share is the backdrop of an object: `tile` loses 1.3.
PLAIN_CAMERAS, PLAIN_SHARE, PLAIN_STEPS, PLAIN_PX = 12, (0.04, 0.25), 2.0, 9
FEW_ANCHORS, FEW_ACCELERATION_M_PER_S2, FEW_NEIGHBOR_M_PER_S, FEW_SEED_EVERY_S = 32, 3.0, 3.0, 0.07
# Steps of appearance for each stride, where a frame has more pixels than this: with STEPS, updates of the recorded
# kitchen before four cameras take 4 ms longer and show less (few-cameras.json).
FEW_STEPS, FEW_STEPS_PIXELS = 6, 20_000
FEW_MOST_ANCHORS = 48  # however large the foreground: the time of an update grows with their square

# --- following motion (tracker) ---
# Most passes of Gauss-Newton over a stride, and the median movement of anchors that calls for another one.
PASSES, AGAIN_M = 3, 0.02
ALIGNING_SHARE = 0.5  # largest share of a budget in seconds
STRIDE_S = 0.08  # longest motion followed at once: more leads too far from where alignment begins
LEAST_ALIGNED, MOST_ALIGNED = 4, 24  # frames in a pass, newest first; the first however short the budget is
STEPS = 10  # most steps of appearance for each stride
SEED_EVERY_S = 0.2
SEED_AT_LEAST_EVERY_S = 0.6  # even if budgets have no room for it
ANCHORS_EVERY_S = 1.0

# --- motion and its least squares ---
KNOTS_PER_S = 15
FREE, FIXED = 10, 3  # knots solved for, and older ones before them
PERSISTENCE = 0.9  # of the acceleration, from knot to knot
ACCELERATION_M_PER_S2 = 5.0
NEIGHBORS, NEIGHBOR_M_PER_S = 4, 2.0
ATTACHED = 3  # anchors of a Gaussian
CLUSTER_OPACITY = 0.5  # in choosing the first anchors Gaussians count by their opacity, above this alike
CLUSTER_ROUNDS = 3  # of k-means
LEAST_REACH, FIRST_REACH = 1e-2, 0.3  # from an anchor to the next, scene units; the latter of one alone
NOISE = 0.2  # of full scale: standard deviation of a pixel's error in the least squares
ROBUST = 1.0  # scale of Cauchy's weights 1 / (1 + e^2 / ROBUST^2)
MOST_ITERATIONS = 60  # of conjugate gradients
# The solution is found when the estimated distance to it, over all unknowns together, is this many of its
# standard deviations.
TOLERANCE = 0.02
