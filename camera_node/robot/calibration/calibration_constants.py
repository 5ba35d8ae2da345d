"""Numbers of a calibration: what is enough, what is refused, what is warned about."""

from __future__ import annotations

# --- poses of a hand-eye calibration (hand_eye.samples, hand_eye.guided_session, hand_eye.calibrate) ---
# Least number of poses, and enough of them: with fewer than GOOD_POSES, each method's own scatter is as large as the
# differences between methods.
MIN_POSES, GOOD_POSES = 3, 10
# The axis of a rotation below MIN_TURN_DEG is mostly noise. The sign of an axis is lost within HALF_TURN_MARGIN_DEG
# of half a turn.
MIN_TURN_DEG, HALF_TURN_MARGIN_DEG = 5.0, 10.0
# Axes within a cone of about this half angle leave the translation along them undetermined.
MIN_SPREAD_DEG = 8.0

# --- a guided session (hand_eye.guided_session) ---
# A session ends with GOOD_POSES, axes spread so far, and this standard deviation of the translation.
GOOD_SPREAD_DEG, GOOD_MM = 15.0, 0.5
# A pose rotated by less than NEW_DEG from a kept one adds little. The arm stands still if it moves and turns by at
# most STILL_MM and STILL_DEG between two frames: beyond them, stamps matter.
NEW_DEG, STILL_MM, STILL_DEG = 8.0, 0.5, 0.1
MIN_TO_SOLVE = 4  # least number of kept poses from which the accuracy is estimated
EXPLAIN_EVERY = 50  # of so many pictures without the target one is examined for the reason, which takes a second

# --- solving a hand-eye calibration (hand_eye.closed_form, hand_eye.samples, hand_eye.refinement) ---
# Most samples of a closed form. OpenCV pairs every sample with every other: more samples take seconds and gain nothing.
MAX_CLOSED_FORM = 60
MAX_SAMPLES = 80  # most samples whose motions are compared; they have 3160 pairs
# The refinement: Student's t of so many degrees of freedom, most rounds, and the relative change of the noise that
# ends them.
DEGREES_OF_FREEDOM, ROUNDS, SETTLED = 8.0, 20, 1e-4
SMALLEST_LIKELIHOOD_GAIN = 1e-10  # relative gain that ends a round
NOISE_STEPS, NOISE_SETTLED = 100, 0.1 * SETTLED  # the same of the steps in which a round's noise is found
MIN_NOISE = 1e-7  # least noise that is assumed (rad, m): perfect data would make the likelihood infinite

# --- judging a hand-eye calibration (hand_eye.calibrate, hand_eye.refinement, pose_pairs) ---
# LARGE: median residuals to warn about. NOTABLE: those of a sample that does not fit the others (less
# is the detector's noise, beside an arm that has nearly none).
LARGE_RESIDUAL_DEG, LARGE_RESIDUAL_MM = 3.0, 20.0
NOTABLE_DEG, NOTABLE_MM = 0.5, 1.0
# A sample's weight is lower if its six whitened residuals have a sum of squares above 32. This happens to one good
# sample in sixty thousand.
OUTLIER_WEIGHT = 0.35
WARNED_OUTLIERS = 5  # most samples that are named as outliers
# Larger median residuals, and a camera farther away than FARTHEST_M, mean wrong input: inverted poses, millimeters, or
# poses of another body.
WORST_DEG, WORST_MM, FARTHEST_M = 15.0, 100.0, 5.0
MOST_QUATERNION_ERROR = 0.01  # tolerated difference of a given quaternion's length from 1

# --- scale and unit of distances to the target (hand_eye.calibrate) ---
# The scale is told where it differs from 1 by more than NOTABLE_SCALE and by SURE standard deviations. A factor beyond
# LARGEST_SCALE is no size of a board. With fewer than POSES_FOR_SCALE poses there is nothing left to judge it by.
NOTABLE_SCALE, SURE, LARGEST_SCALE, POSES_FOR_SCALE = 0.005, 5.0, 2.0, 5
MILLIMETERS_M = 20.0  # median distance beyond which poses are in millimeters

# --- targets (targets, lens_calibration, inputs) ---
# With fewer corners of a board its orientation is too uncertain; fewer markers may be read into noise.
MIN_CORNERS, MIN_MARKERS = 6, 3
# Ratio of reprojection errors above which the second of the two poses of a flat target is ruled out.
AMBIGUOUS = 1.5
# That is asked only of targets with fewer corners than AMBIGUOUS_CORNERS; an error below AMBIGUOUS_PX is chance.
AMBIGUOUS_CORNERS, AMBIGUOUS_PX = 12, 0.05
# Steps of a corner's refinement, the motion (px) that ends them, and the least and largest half side of its window.
SUBPIX_STEPS, SUBPIX_PX = 40, 1e-4
LEAST_WINDOW_PX, MOST_WINDOW_PX = 2, 11
MOST_SQUARES = 16  # most squares across and down, of ChArUco boards that are tried
UNSEEN_MARKERS = 3  # most markers that such a board has beyond the highest that is seen
EXPLAINED = 4  # pictures without the target that are examined for the reason, which takes a second

# --- a lens (lens_calibration, rig.rig_calibration) ---
MIN_VIEWS = 4  # least number of pictures that show the target
# With all views parallel to the sensor, focal length and distance cannot be told apart.
MIN_TILT_DEG = 10.0
# Reprojection error of a picture that is left out, in medians of all.
OUTLIER_ERROR = 4.0
LARGEST_FOCAL_STD = 0.2  # standard deviation, as a share of the focal length; with more, the pictures determine none
COVERED_CELLS = 6  # cells across and down, by which the covered share of the picture is told
# Focal lengths over the image's longer side: 136 and 7 degrees of view. The solver diverges beyond them if the images
# do not determine a lens.
SHORTEST_FOCAL, LONGEST_FOCAL = 0.2, 8.0

# --- rigs (rig.rig_calibration, rig.bundle_adjustment) ---
# Pairs of cameras with fewer common moments than MIN_SHARED are not joined; with fewer than FEW_SHARED a note says so.
MIN_SHARED, FEW_SHARED = 2, 5
# Reprojection errors beyond ROBUST_PX count linearly (Huber); below OUTLIER_PX a view is never left out.
ROBUST_PX, OUTLIER_PX = 1.0, 1.0
# A median error beyond it: pictures of one moment are not of one instant. A usual rig has less than half a pixel.
LARGEST_PX = 5.0
# Levenberg-Marquardt: share of the diagonal added at first and at most, number of steps, and the relative gain that
# ends them.
FIRST_DAMPING, LAST_DAMPING, MOST_STEPS, SMALLEST_GAIN = 1e-3, 1e12, 100, 1e-9
DAMPING_FACTOR = 10  # so many times more damping after a step that gained nothing, less after another

# --- moments of a rig (rig.rig_inputs) ---
# Moments of a video are MOMENT_S apart. The target stands still if its corners move by less than STILL_PX between two
# frames.
MOMENT_S, STILL_PX = 0.5, 0.5
# A live moment is new where the target has moved by this share of the image's width.
NEW_SHARE = 0.05
# A live camera without a new frame for so long shows nothing at that moment.
LIVE_WAIT_S = 1.0
# Horizontal angle of view that a live camera is opened with. Any will do: its lens is estimated from the pictures.
UNKNOWN_FOV_DEG = 60.0
