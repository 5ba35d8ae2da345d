"""Numbers of the Gaussian field, each tuned once. None is an option. The layers have their own tuned numbers."""

from __future__ import annotations

# --- seeding (seeding) ---
# Scale of new Gaussians in distances to their neighbors, their opacity, and pixels tried for each, because those whose
# rays meet no surface are discarded.
SEED_SCALE, SEED_OPACITY, SEED_CANDIDATES = 0.5, 0.3, 4
# Several views see each place: one of SEED_VIEWS views, and SEED_MOST_SEE of them at most.
SEED_VIEWS, SEED_MOST_SEE = 3.0, 6.0

# --- learning rates at the start of a fit (field, kernels.optimizer_step) ---
# Of positions in pixels; of logarithms of scales; of quaternions; of opacities before the sigmoid.
RATE_POSITION, RATE_SCALE, RATE_ROTATION, RATE_OPACITY = 0.4, 0.08, 0.02, 0.15
RATE_COLOR, RATE_SH = 0.02, 0.002  # of colors, and of further spherical harmonics
# A Gaussian trains at full rates for SETTLE_STEPS steps; then they fall as 1 / steps, down to the share RATE_SETTLED.
SETTLE_STEPS, RATE_SETTLED = 300.0, 0.1

# --- density control (densification, carried_camera.scan_field) ---
# Share of Gaussians that are split at once, those of largest gradient first; opacity below which they are removed;
# share of an image's width above which they are split first.
GROW_SHARE, PRUNE_OPACITY, WIDEST = 0.15, 0.02, 0.2
SPLIT_SHRINK = 1.6  # divides the scales of both halves of a split Gaussian (Kerbl et al.)
SPLIT_APART = 0.5  # of a draw from the Gaussian that is split, to either side, to where its halves go
SHARP_PX = 1.0  # width in the image up to about which Gaussians are cloned without shrinking

# --- bounds of parameters (kernels.optimizer_step, kernels.project, kernels.project_backward, planar, export, page) ---
POSITION_LIMIT = 100.0  # scene units from the center
LARGEST, ASPECT = 0.5, 20.0  # standard deviation, times the distance from the center; longest to shortest axis
LOG_SCALE_LOW, LOG_SCALE_HIGH = -12.0, 4.0  # logarithm of a scale, wherever it is read
LOG_SCALE_LEAST = -11.0  # logarithm of a scale that is trained
RAW_OPACITY_LIMIT = 9.0  # before the sigmoid, to either side: 1.2e-4 to .99988
COLOR_LOW, COLOR_HIGH = -0.5, 1.5  # a Gaussian's color may leave [0, 1] a little: rendered ones are clamped
GRADIENT_LIMIT = 1e6  # largest gradient that an update takes

# --- rendering (kernels.composite, kernels.project, buffers, planar, layers.kernels.align) ---
# Alpha, what a Gaussian adds to one pixel. At most: no Gaussian hides everything, and an alpha that is clamped has no
# gradient. At least: a Gaussian ends where its alpha is lower.
ALPHA_MAX, ALPHA_MIN = 0.99, 1.0 / 255.0
LOW_PASS = 0.3  # pixels squared, added to projected variances: nothing is sharper than a pixel
STOP = 1e-4  # transmittance below which compositing stops
MAX_PAIRS = 1 << 22  # pairs of a Gaussian and a tile, a camera: further Gaussians are left out, to bound memory
STEEPEST = 0.1  # cosine between ray and normal below which a Gaussian's plane has no depth (``planar``)

# --- semi-global matching, found on the plates of `room` and of a recorded kitchen (kernels.semi_global) ---
SWEEP_BOUND = 0.15  # difference of a channel beyond which it does not matter how different
SWEEP_UNSEEN = 0.5  # cost, in those of SWEEP_BOUND, where no other camera sees
SWEEP_SECOND_OF, SWEEP_SECOND = 3, 0.3  # other cameras from which on the second best counts, and its share
SWEEP_SMALL, SWEEP_LARGE = 0.03, 8.0  # penalties of one step of depth between neighbors, and of more
SWEEP_EDGE = 10.0  # SWEEP_LARGE falls to half at a change of gray of the inverse of this
SWEEP_DISTINCT = 0.02  # cost, in the same unit, by which depths must be better than others: walls of one color are not
