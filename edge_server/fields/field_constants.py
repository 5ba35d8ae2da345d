"""Numbers of what representations share, and of the ray-based ones, each tuned once. None is an option."""

from __future__ import annotations

# --- the scene's box (scene_box, view_store) ---
NEAR_SHARE = 0.4  # of the cameras' distance to the scene: no density is nearer to them in contracted scenes
# In other scenes density keeps away by the first, a share of that distance, at least; otherwise it begins so many radii
# of the box (the second) before the box's center.
NEAR_LEAST, NEAR_RADII = 0.05, 1.8
# Sines of the angle between a camera's axis and the direction to a point (ASTRAY, MEETS, ASIDE):
ASTRAY = 0.3  # a camera further off than this may be an outlier
MEETS = 0.15  # half of the cameras are within this of a true meeting point
ASIDE = 0.7  # half of the cameras are further than this from a point where they do not meet
ASTRAY_MEDIANS = 4.0  # an outlier is also so many times as far off as half of the others
MOST_TRIED = 32  # cameras whose pairs are tried if no meeting point was found
FAR_AWAY = 10.0  # times the usual distance between cameras: nearer ones belong together
OUTWARDS = 0.5  # length of the mean of the cameras' axes, below which they look outwards from where they stand
# Distance of a scene that nothing tells: times the cameras' extent; in meters, where all cameras are at one place.
GUESSED_SPREADS, GUESSED_M = 3.0, 3.0
SEEN_PERCENTILE = 10  # of the radii that cameras see whole: nine of ten cameras see the box of an object whole
FINAL_BOX_CAMERAS = 4  # cameras from which on a scene's box is kept
SIMILAR_BOX = 0.1  # share of its radius by which a box found anew may differ: what was learned in the old one is kept

# --- what is behind the scene (background) ---
PLAIN_STEPS = 8  # steps of 255: a plain background varies by no more than this
# A background is plain where this share of a picture's edge is; the pictures may miss it up to this percentile.
PLAIN_EDGE, PLAIN_PERCENTILE = 0.6, 20
EMPTY_COLOR, EMPTY_ALPHA = 0.06, 16  # distance of a color, summed over channels, and alpha below which a pixel is empty

# --- cameras (camera_rows, plane_sweep, settings, supervision, cameras.pose_corrections, splat.layers) ---
MIN_NEAR = 0.01  # scene units: the nearest that a camera's near plane may be
LENS_FIELD = 1.3  # times a camera's field of view, within which a projection's slopes are taken (``lens_terms``)
# What moved: pixels that differ by more than CHANGE (of 255), after blurring, above the noise of sensors and of video
# compression; and the pixels within MARGIN_PX of those.
CHANGE, MARGIN_PX = 16, 2
SAME_POSE = 1e-3  # of all numbers of a pose's matrix (meters, entries of the rotation): one that differs by more is new
MIN_VIEWS = 2  # cameras: there is no density where fewer of them look (or all, if there are fewer)

# --- cells of space that get samples (kernels.occupancy, occupancy_grid, settings, trained_field) ---
OCCUPANCY_CELLS = 64  # a side, a multiple of 4
OCCUPANCY_EVERY = 8  # steps between refreshes
OCCUPANCY_PHASES = 4  # refreshes until every cell has been sampled
OCCUPANCY_FADE = 0.75  # share of a cell's density that is left at each sample
EMPTY_DENSITY = 0.5  # density per scene unit that counts as empty: a step of it dims by a hundredth or two
MOVING_DENSITY = 1.5  # times EMPTY_DENSITY, that a cell has at least where something moved
# Where the scene is thinner, a cell is not empty that reaches the first as a share of the mean over seen cells; a cell
# counts in that mean by the second times EMPTY_DENSITY at most.
OCCUPIED_OF_MEAN, OCCUPIED_MOST = 0.7, 10.0

# --- rays (kernels.plane_sweep, kernels.rays, kernels.render, kernels.train, kernels.volume_rendering) ---
HORIZON = 20.0  # scene units, at which contracted scenes end: nothing behind it moves in any picture
OPAQUE_DEPTH = 9.2103404  # optical depth at which a ray ends: a transmittance of 1e-4
# A ray is followed until the grid's densities make this optical depth, then the field is asked whether it is
# opaque. Less than OPAQUE_DEPTH, so that few samples behind a surface are evaluated; but each query costs a
# round.
ASKED_DEPTH = 5.0

# --- Adam (trained_field, cameras.appearance, kernels.adam, splat.kernels.optimizer_step, viewpoints.fisher) ---
BETA1, BETA2 = 0.9, 0.99  # of Adam: decay of its first and of its second moment
# Decay of the first moment for encodings and their networks: a first fit has a hundred steps or so, and with .9 a tenth
# of them pass before Adam forgets the gradients of fog that is gone.
BETA1_FIELD = 0.65
NOMINAL_RAYS = 4096.0  # gradients are scaled as if a step had so many rays: Adam's epsilon keeps its meaning
GRADIENT_LIMIT = 1e3  # largest gradient: a hundred times what healthy scenes show; keeps the second moment finite
PARAMETER_LIMIT = 1e2  # largest absolute value of a parameter

# --- first values of networks (kernels.mlp, tensorf.field) ---
FIRST_DENSITY = 0.3  # at first, per scene unit: a scene unit of fog dims by a quarter, so every sample gets a gradient
FIRST_OUTPUTS = 0.1  # factor on the first weights of a network's last layer: gray fog

# --- training, where a representation's settings say nothing else (settings) ---
EPSILON = 5e-3  # of Adam: rarely seen vertices are trusted less
RATE, RATE_NET, RATE_END = 8e-2, 2e-2, 0.1  # of encodings and networks as a fit begins; the share left at its end
HIDDEN, HIDDEN_LAYERS = 32, 1  # units of a layer (a multiple of 4), and layers
SAMPLES_START, SAMPLES_RAMP = 64, 600  # samples of a ray at first, as early fields are foggy; steps to the full number
DISTORTION = 1e-2  # weight of the loss that gathers density along rays

# --- time and loss of a fit (training_schedule, stepped_field, splat.layers.static_layer) ---
LATE = 1.1  # times a budget in seconds: a fit may end so late rather than make no step
STEP_TIMES = 5  # latest steps whose median tells how long a step takes
LOSS_STEPS = 32  # latest steps of a fit whose mean loss is reported

# --- plane sweep and guide (plane_sweep, settings, trained_field, kernels.plane_sweep, kernels.volume_rendering) ---
SWEEP_TOLERANCE = 0.08  # between colors, summed over channels: with more, walls are found where there are none
SWEEP_VIEWS = 32  # largest number of views that vote, below ``kernels.plane_sweep.UNMARKED``
EMPTY_VIEWS = 2  # a cell is empty if this many views see plain background there
SWEEP_MIDDLE = 0.03  # of a score, that a distance e times as large, or as small, as the cameras' to the scene costs
GUIDE_CELLS = 96  # a side: finer cells hardly guide better, and cost their cube
GUIDE_RAYS = 1 << 16  # rays swept at most; the pixels between two rays share their depth
GUIDE_SCORE = 0.3  # least score of ``score_cells``: half of the cameras that see a cell, and at least three
GUIDE_VIEWS = 3  # fewest views that must see a cell: two agree on a color too often
# The depth guide: its weight where the settings leave it open; views up to which it is used in any scene; share of a
# budget in seconds that its plane sweep may take; distance of weight from it, as a share of its own distance, at which
# that costs half of the most.
GUIDE_WEIGHT, FEW_VIEWS, SWEEP_SHARE, GUIDE_REACH = 0.1, 6, 0.5, 0.04
GUIDE_STEPS = 300  # steps after which the guide weighs nothing any more

# --- the hash-grid field (ngp.field) ---
# Cells a side of the finest level, where the settings leave it open: at most, and as long as no pixel is known.
NGP_FINEST, NGP_FINEST_AT_FIRST = 512, 256
NGP_FIRST_TABLE = 1e-4  # bound of the tables' first values

# --- the proposal-sampled field (nerfacto.kernels.proposal, nerfacto.kernels.train) ---
NERFACTO_RAW_GAIN = 4.0  # raw density per unit of the table: it must rise in tens of steps at the hash levels' rate
NERFACTO_RAW_START = -1.2  # raw density where the table is 0: the thin fog that the network starts with too
NERFACTO_CUTOFF_DEPTH = 10.0  # optical depth behind which bins are dropped
NERFACTO_DARK_SHARE = 0.1  # weight of a bin without light in uniform allocation; one in full light: 1 more
NERFACTO_WEIGHT_FLOOR = 1e-3  # in the interlevel loss's denominator, so that a weight of 0 does not divide

# --- the vector-matrix field (tensorf.field) ---
TENSORF_FINEST = 256  # vertices a side by default: finer planes outgrow the second-level cache

# --- threads (threads.brief_wait, threads.thread_pool, experiments.engine.engine) ---
# Looks of a wait, each followed by a pause of the core, of 30 to 140 cycles: 20 to 90 us; without a pause (not x86) a
# few. Within a training step the next kernel comes within 50 us; to be woken takes 30 to 70 us on two shared cores.
WAIT_LOOKS = 2000
# Workers of a pool: more gain nothing, or lose, as each takes the GIL once a job (docs/results/gpu/threads.json).
MOST_WORKERS = 8

# --- while kernels are compiled (fields.compiling) ---
# Between two lines of the log: a long compilation shows that it goes on, and a short one is a single line.
COMPILING_EVERY_S = 10.0
