"""Constants of a scan's field, each tuned once on recorded footage. ``scan_options`` turns some into options."""

from __future__ import annotations

from typing import Any

# --- rates without a schedule, so that a fit may last any time (carried_field, scan_field) ---
SETTLE_STEPS = 80  # steps of a Gaussian at full rates, then they fall as 1 / steps
# Learning rates of positions, pixels, and of colors: lower than for moving scenes, as seeds lie on surfaces already.
POSITION_PX, COLOR = 0.2, 0.012
DISSIMILARITY = 0.02  # weight of (1 - SSIM) / 2 in the loss; three times as much raises SSIM and costs PSNR

# --- options of a field, and how many Gaussians (carried_field, scan_field) ---
PER_PIXEL = 0.78  # Gaussians per pixel of one image; more cost time in every step, and sharpen little
LEAST, MOST = 8192, 1 << 18  # bounds of the number of Gaussians; the most take 60 MB, and .1 s per step
NEAR_SHARE = 0.1  # of the cameras' distance to the scene: near plane for cameras that are carried close to objects

# --- seeds from measured depth (carried_field, seeds_on_depth, scan_field) ---
SEED_VIEWS = 60  # most views that provide seeds: the others see hardly anything new
LEAST_SIDE = 5  # least image side in pixels: normals come from differences over this many
CELLS = (16, 8, 4)  # side of a quadtree's leaves in pixels
DETAIL = 0.06  # standard deviation of a leaf's color, over channels, above which it is divided
MIXED = (0.01, 0.75)  # shares of wanted pixels in a leaf between which it is divided; below the first it is left out
COVERED = 0.6  # opacity above which a pixel shows a surface
# If the rendered surface lies behind the measured one by more than this share of the depth, plus these meters, the
# nearer surface is missing.
BEHIND_SHARE, BEHIND_M = 0.07, 0.02
DEPTH_M = 1e-3, 1e4  # bounds of a depth: no sensor measures values beyond; NaN is outside, too
# Depth that spans more within 3 x 3 pixels, as a share plus meters, lies across two surfaces, or is wrong.
JUMP_SHARE, JUMP_M = 0.05, 0.02
# A seed's standard deviation in sides of its leaf, its thickness as a share of that, and its opacity.
WIDTH, FLATNESS, OPACITY = 0.6, 0.2, 0.8
STEEPEST = 0.3  # least cosine to the view: bounds how far seeds are stretched along a surface
ORIGIN_GRID_M = 1e4  # meters to which a scene's origin is rounded: within 5 km of the world's own nothing is shifted
GUESSED_OPACITY = 0.5  # opacity of seeds at a guessed depth

# --- depth by plane sweep, where none is measured (scan_field, frame_stereo) ---
# Found on `redkitchen`, against its depth camera.
SWEPT_VIEWS = 40  # views that are swept, at most
# No further view is swept once the last SWEPT_LAST views show no seed yet in a mean share of less than SWEPT_NEW of
# their pixels: `lego` and `fox` need 8 views, `redkitchen` without depth 14.
SWEPT_LAST, SWEPT_NEW = 4, 0.05
SWEPT_PIXELS = 20_000  # most pixels of an image that is matched; larger ones are downscaled
SWEPT_STEPS = 64  # inverse depths, from 0
SWEPT_NEAR = 0.3  # nearest depth, share of the distance to the scene
SWEPT_WITH = 4  # other views that a view is compared with
SWEPT_ANGLES_DEG = 1.0, 5.0, 30.0  # parallax of another view: least, best, most
SWEPT_FACING, SWEPT_TURNED = 0.8, 3.0  # least cosine between two views' axes; cost of a turn in log parallax
SWEPT_BLUR_PX = 0.7  # interpolation blurs the other image about as much
CONTRAST_PX = 4.0  # standard deviation of the window whose mean and contrast normalize an image
CONTRAST_NOISE, CONTRAST_GAIN = 0.02, 0.2  # contrast of noise, of 1; normalized value of a deviation of one contrast

# --- growth where the residual is large (scan_field) ---
GROW_EVERY = 10  # steps between additions of Gaussians
GROWN_ERROR = 0.08  # color error, blurred over 3 x 3 pixels, above which detail is missing
GROWN_CELLS, GROWN_DETAIL = (8, 4, 2), 0.05  # as CELLS and DETAIL, for new Gaussians
GROWN_WIDTH, GROWN_OPACITY = 0.5, 0.5  # as WIDTH and OPACITY, for new Gaussians
GROWN_MOST = 400  # new Gaussians at a time
AGREES = 0.1  # largest relative difference of measured and rendered depth on the same surface
NEARER = 0.003  # share of the depth by which new Gaussians lie in front of the rendered surface
PRUNE_EVERY = 100  # steps between removals of Gaussians

# --- exposures and poses (exposures, scan_field, pose_alignment) ---
EXPOSED_FROM = 31  # step from which exposures are estimated: before, the field shows no colors
TOWARDS_ONE = 0.02  # damping of the least squares towards gain 1 and bias 0, squared colors
EXPOSURE_SHARE = 0.3  # share of the way to a new estimate that is taken
GAINS, MOST_BIAS = (0.4, 2.5), 0.3  # bounds of an exposure's gain; largest absolute bias
GAUGE_EVERY, GAUGE_SHARE = 40, 0.04  # steps between corrections of the gauge; share of the mean shift removed
# A view's pose is corrected in full for this many steps, then with decreasing rates: later ones follow the noise of
# single steps. A field of sequential views is always young where they are, and takes all corrections in full.
FULL_STEPS = 3
MOST_DEG, MOST_SHARE = 5.0, 0.1  # largest turn of a pose; largest shift, share of the cameras' distance to the scene

# --- sequential views (carried_field, keyframe_choice, reported_poses, plausibility) ---
STEPS_A_KEYFRAME = 24  # steps per new keyframe: with fewer, new regions stay blurred; with more, they appear late
# Newest keyframes of each camera, and share of the steps that they get: with more, earlier ones are forgotten.
NEWEST, NEWEST_SHARE = 4, 0.4
FRESH_STEPS = 3  # first steps, on the newest keyframe only: the newest frame of redkitchen gains 0.8 dB
GROWN_UPTO = 0.7  # share of the Gaussians beyond which none is inserted: the rest is reserved to seed new places
KEPT_PIXELS = 1 << 23  # pixels of all keyframes together: 60 MB with their depth
LEAST_KEPT, MOST_KEPT = 32, 400  # keyframes, whatever their size: each new one is compared with all others
KEPT_CORRECTIONS = 2048  # corrections kept of removed keyframes, for held-out and late frames of their time
# A new view's exposure is found from pixels with more opacity than the first (surfaces) and less error than the second
# (consistent).
EXPOSED_OPACITY, EXPOSED_ERROR = 0.7, 0.25
EXPOSED_SHARE = 0.2  # least share of such pixels
BARE = 0.05  # contrast (standard deviation) below which a view shows nothing; redkitchen's views have .15 and more
BEGINS = (2, 4, 8)  # numbers of keyframes without depth at which a field restarts

# --- the pose of a new frame, by alignment with a rendering (carried_field, plausibility, pose_alignment) ---
RENDERED_HALVINGS = 1  # halvings of the rendered size: half is as good, and is the size of the finest level
LEVELS = ((2, 3), (1, 3), (0, 2))  # for each level its further halvings and iterations: coarse to fine
ALIGNMENTS = 2  # renderings: the second one from the pose that the first alignment found
SURE = 0.9  # share of consistent pixels at the predecessor's correction that makes alignment unnecessary
MOST_ALIGNED, LEAST_ALIGNED = 5000, 50  # most and least pixels per level
ALIGNED_OPACITY = 0.5  # opacity above which a pixel shows a surface
SOFT = 0.1  # gray levels: pixels that differ by more are inconsistent, and have little weight
# A turn of PRIOR_RAD, or a shift of PRIOR_M, from the given pose costs as much as a squared error of PRIOR_ERROR.
PRIOR_RAD, PRIOR_M, PRIOR_ERROR = 0.02, 0.03, 1e-3
LONGEST_RAD = 0.05  # largest rotation in a step

# --- a camera located by its images, not its reported poses (reported_poses, and those above) ---
GUESSED_ERROR = 4e-5  # as PRIOR_ERROR, around a guess: five times the distance has the same cost
ENOUGH_OVERLAP = 0.6  # share of pixels in view above which a larger one makes a guess no better
DOUBTFUL = 0.9  # share of consistent pixels below which places other than the reported one are tried
LOCATED = 0.7  # least share of consistent pixels to accept another place
# Largest movement between two keyframes, in multiples of the largest correction: more is a wrong match, or a leap.
FARTHEST = 6.0
LOST = 1  # successive frames not located, after which one is placed where the one before was
DOUBTS = 2  # successive keyframes that fit better elsewhere, after which reported poses are not trusted
LEAPT = 2  # further keyframes consistent with a leap of reported poses, after which the leap is accepted
ASTRAY_FOR = 4  # number of keyframes from which the cause of misfitting reported poses is named
# Difference of rotation matrices' entries: below the first, rotations are equal (a tracker's noise is larger); above
# the second, a camera has turned.
SAME_TURN, TURNED = 1e-6, 0.05
# Corners of an image, tracked to the next keyframe: at most, at least, and their least distance.
CORNERS, LEAST_CORNERS, CORNERS_APART_PX = 200, 8, 3
CORNER_QUALITY = 0.01  # least quality of a corner, as a share of the best corner's
# Median by which corners move elsewhere than reported, pixels and share of the way: above, pictures contradict poses.
# Keyframes of `redkitchen`, .3 s apart, have a share of more than .2 in one of ten pairs once their turns are taken
# out, in three of four as they are.
BESIDE_PX, BESIDE_SHARE = 1.0, 0.25
# Excess of keyframe pairs that contradict an unchanged reported rotation, at which poses count as lacking rotation.
UNTURNED = 6
OTHER_UNIT = 2.5  # least ratio of distances that indicates another unit, not single errors: feet in meters are 3.3
UNIT_LOG = 0.45  # largest difference of its logarithm from that of a known unit for that unit to be named
FOLLOWED = 0.1  # tolerated loss of consistent pixels where reported motion leads, relative to the best pose
# Longest time between two keyframes for a leap: later the camera may be anywhere, and a fit where it was tells none.
LONGEST_LEAP_S = 1.0
FASTEST = 3.0  # largest motion of a camera since the last one, in multiples of that

# --- frames and poses that cannot be right (carried_field, reported_poses, plausibility, pose_alignment) ---
# A frame is left out that has this share of the field in view, but fewer of its pixels as expected than the second.
LEAST_OVERLAP, LEAST_AGREEING = 0.3, 0.5
FLAT = 0.15  # share of the expected contrast below which a lens counts as covered; a third of the exposure has 0.33
PATIENCE = 10  # successive frames of a camera left out, after which the next is accepted: it may be in a new place
MOVED_EVERY = 4  # stride of the tested pixels
# A pixel was free space if an earlier frame saw farther by more than this share of the depth, plus these meters.
MOVED_SHARE, MOVED_M = 0.1, 0.05
MOVED_LEAST = 0.005  # least share of such pixels in an image: less is depth noise
JUDGED = 24  # newest keyframes of a camera by which its poses are judged
MOUNT_POSES = 256  # newest poses from which a mount error is estimated: takes 15 ms
DRIFT_SHARE = 0.6  # share of the largest correction above which poses count as drifting
LATE_S, LATE_EXPLAINS = 0.03, 0.4  # least reported delay of poses; share of the corrections that it must explain
LONGEST_GAP_S = 1.5  # longest time between two keyframes from which a velocity is computed


def scan_options(pixels: int, tracked: bool) -> dict[str, Any]:
    """Options of a field for a scan. pixels: of one image. tracked: whether its poses come from a tracker."""
    return {"scan": True, "refine": tracked, "gaussians": min(max(int(PER_PIXEL * pixels), LEAST), MOST)}
