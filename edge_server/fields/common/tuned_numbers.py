"""Numbers that representations share, each tuned once. None is an option."""

from __future__ import annotations

# --- the scene's box (scene_box, view_store) ---
NEAR_SHARE = 0.4  # of the cameras' distance to the scene: no density is nearer to them in contracted scenes
NEAR_LEAST, NEAR_RADII = 0.05, 1.8  # in others the same share at least, and so many radii of the box before its center
# Sines of the angle between a camera's axis and the direction to a point.
ASTRAY = 0.3  # a camera further off than this may be an outlier
MEETS = 0.15  # half of the cameras are within this of a true meeting point
ASIDE = 0.7  # half of them are further than this from a point where they do not meet
ASTRAY_MEDIANS = 4.0  # an outlier is also so many times as far off as half of the others
MOST_TRIED = 32  # cameras whose pairs are tried if no meeting point was found
FAR_AWAY = 10.0  # times the usual distance between cameras: nearer ones belong together
OUTWARDS = 0.5  # length of the mean of the cameras' axes, below which they look outwards from where they stand
GUESSED_SPREADS, GUESSED_M = 3.0, 3.0  # distance of a scene that nothing tells: times the cameras' extent; of one place
PLAIN_STEPS = 8  # of 255: a plain background varies by no more than this
PLAIN_EDGE, PLAIN_PERCENTILE = 0.6, 20  # share of a picture's edge that is plain; of all pictures, this one has as much
SEEN_PERCENTILE = 10  # nine of ten cameras see the box of an object whole
FINAL_BOX_CAMERAS = 4  # cameras from which on a scene's box is kept
SIMILAR_BOX = 0.1  # share of its radius by which a box found anew may differ: what was learned in the old one is kept

# --- cameras (camera_rows, supervision) ---
MIN_NEAR = 0.01  # scene units
LENS_FIELD = 1.3  # times a camera's field of view, within which a projection's slopes are taken (``lens_terms``)
# What moved: pixels that differ by more, of 255, after blurring, above the noise of sensors and of video compression;
# and those around them.
CHANGE, MARGIN_PX = 16, 2
SAME_POSE = 1e-3  # of all numbers of a matrix: a camera whose pose differs by more has moved
MIN_VIEWS = 2  # no density where fewer cameras look, or all, if there are fewer

# --- cells of space that get samples (occupancy_grid) ---
OCCUPANCY_CELLS = 64  # a side, a multiple of 4
OCCUPANCY_EVERY = 8  # steps between refreshes
OCCUPANCY_PHASES = 4  # refreshes until every cell has been sampled
OCCUPANCY_FADE = 0.75  # share of a cell's density that is left at each sample
EMPTY_DENSITY = 0.5  # density per scene unit that counts as empty: a step of it dims by a hundredth or two
MOVING_DENSITY = 1.5  # times EMPTY_DENSITY, that a cell has at least where something moved
# Where the scene is thinner, what reaches this share of the mean over seen cells is not empty; a cell counts in it by
# so many times EMPTY_DENSITY at most.
OCCUPIED_OF_MEAN, OCCUPIED_MOST = 0.7, 10.0

# --- rays (kernels.rays, kernels.volume_rendering, kernels.train) ---
HORIZON = 20.0  # contracted scenes end here, in scene units: nothing behind it moves in any picture
OPAQUE_DEPTH = 9.2103404  # optical depth at which a ray ends: a transmittance of 1e-4
# A ray is followed until the grid's densities make this optical depth, then the field is asked whether it is
# opaque. Less than OPAQUE_DEPTH, so that few samples behind a surface are evaluated; but each query costs a
# round.
ASKED_DEPTH = 5.0

# --- training (trained_field, training_schedule, stepped_field, kernels.adam, kernels.mlp) ---
BETA1, BETA2 = 0.9, 0.99  # of Adam
# The first of encodings and their networks: a first fit has a hundred steps or so, and with .9 a tenth of them pass
# before Adam forgets the gradients of fog that is gone.
BETA1_FIELD = 0.65
NOMINAL_RAYS = 4096.0  # gradients are scaled as if a step had so many rays: Adam's epsilon keeps its meaning
GRADIENT_LIMIT = 1e3  # a hundred times what healthy scenes show; keeps the second moment finite
PARAMETER_LIMIT = 1e2
FIRST_DENSITY = 0.3  # a scene unit of fog dims by a quarter: every sample gets a gradient at first
FIRST_OUTPUTS = 0.1  # factor on the first weights of a network's last layer: gray fog
# Where a representation's settings say nothing else:
EPSILON = 5e-3  # of Adam: rarely seen vertices are trusted less
RATE, RATE_NET, RATE_END = 8e-2, 2e-2, 0.1  # of encodings and networks as a fit begins; the share left at its end
HIDDEN, HIDDEN_LAYERS = 32, 1  # units of a layer (a multiple of 4), and layers
SAMPLES_START, SAMPLES_RAMP = 64, 600  # steps along a ray at first, as early fields are foggy; steps to the full number
DISTORTION = 1e-2  # weight of the loss that gathers density along rays
LATE = 1.1  # times a budget in seconds: a fit may end so late rather than make no step
STEP_TIMES = 5  # latest ones whose median tells how long a step takes
LOSS_STEPS = 32  # latest ones of a fit whose mean loss is reported

# --- the plane sweep (plane_sweep, kernels.plane_sweep), and seeds and guides from it ---
SWEEP_TOLERANCE = 0.08  # between colors, summed over channels: with more, walls are found where there are none
SWEEP_VIEWS = 32  # largest number of views that vote, below ``kernels.plane_sweep.UNMARKED``
EMPTY_VIEWS = 2  # a cell is empty if this many views see plain background there
EMPTY_COLOR, EMPTY_ALPHA = 0.06, 16  # distance of a color, summed over channels, and alpha below which a pixel is empty
SWEEP_MIDDLE = 0.03  # of a score, that a distance e times as large, or as small, as the cameras' to the scene costs
GUIDE_CELLS = 96  # a side: finer cells hardly guide better, and cost their cube
GUIDE_RAYS = 1 << 16  # swept at most; the pixels between two rays share their depth
GUIDE_SCORE = 0.3  # least score of ``score_cells``: half of the cameras that see a cell, and at least three
GUIDE_VIEWS = 3  # fewest views that must see a cell: two agree on a color too often
# The depth guide: its weight where the settings leave it open; views up to which it is used in any scene; share of a
# budget in seconds that its plane sweep may take; distance of weight from it, as a share of its own distance, at which
# that costs half of the most.
GUIDE_WEIGHT, FEW_VIEWS, SWEEP_SHARE, GUIDE_REACH = 0.1, 6, 0.5, 0.04
GUIDE_STEPS = 300  # after which the guide weighs nothing any more

# --- threads (threads.brief_wait, threads.thread_pool) ---
# Looks of a wait, each followed by a pause of the core, of 30 to 140 cycles: 20 to 90 us; without a pause (not x86) a
# few. Within a training step the next kernel comes within 50 us; to be woken takes 30 to 70 us on two shared cores.
WAIT_LOOKS = 2000
# More workers gain nothing, or lose: each takes the GIL once a job (docs/results/gpu/threads.json).
MOST_WORKERS = 8
SERVER_NICE = 5  # of workers in a server that answers cameras meanwhile

# --- while kernels are compiled (fields.compiling) ---
# Between two lines of the log: a long compilation shows that it goes on, and a short one is a single line.
COMPILING_EVERY_S = 10.0
