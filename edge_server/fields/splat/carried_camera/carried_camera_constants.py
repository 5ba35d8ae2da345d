"""Numbers of a scan's field, each tuned once on recorded footage. ``scan_options`` makes options of some of them."""

from __future__ import annotations

from typing import Any

# --- rates without a schedule, so that a fit may go on for as long as it likes (carried_field, scan_field) ---
SETTLE_STEPS = 80  # steps of a Gaussian at full rates, then they fall as 1 / steps
# Learning rates of positions, pixels, and of colors: lower than where things move, as seeds lie on surfaces already.
POSITION_PX, COLOR = 0.2, 0.012
DISSIMILARITY = 0.02  # weight of (1 - SSIM) / 2 in the loss; three times as much raises SSIM and costs PSNR

# --- options of a field, and how many Gaussians (carried_field, scan_field) ---
PER_PIXEL = 0.78  # Gaussians for each pixel of one image; more cost time in every step, and sharpen little
LEAST, MOST = 8192, 1 << 18  # Gaussians, whatever the images; the most take 60 MB, and steps of a tenth of a second
NEAR_SHARE = 0.1  # of the cameras' distance to the scene: a near plane for cameras that are carried close to things

# --- seeds from measured depth (carried_field, seeds_on_depth, scan_field) ---
SEED_VIEWS = 60  # views that seeds come from, at most: the others see hardly anything new
LEAST_SIDE = 5  # pixels that an image has a side, at least: normals come from differences over so many
CELLS = (16, 8, 4)  # pixels a side of a quadtree's leaves
DETAIL = 0.06  # standard deviation of a leaf's color, over channels, above which it is divided
MIXED = (0.01, 0.75)  # shares of wanted pixels in a leaf between which it is divided; below the first it is left out
COVERED = 0.6  # opacity above which a pixel shows a surface
# If what is shown lies behind what is measured by more than this share of the depth, plus these meters, the nearer is
# missing.
BEHIND_SHARE, BEHIND_M = 0.07, 0.02
DEPTH_M = 1e-3, 1e4  # bounds of a depth: what lies beyond was measured by nothing; NaN is neither
# Depth that spans more within 3 x 3 pixels, as a share plus meters, is of two surfaces, or of none.
JUMP_SHARE, JUMP_M = 0.05, 0.02
# A seed's standard deviation in sides of its leaf, its thickness as a share of that, and its opacity.
WIDTH, FLATNESS, OPACITY = 0.6, 0.2, 0.8
STEEPEST = 0.3  # least cosine to the view: nothing is stretched along a surface further than this says
GUESSED_OPACITY = 0.5  # opacity of seeds at a depth that is guessed

# --- depth by plane sweep, where none is measured (scan_field, frame_stereo) ---
# Found on `redkitchen`, against its depth camera.
SWEPT_VIEWS = 40  # views that are swept, at most
# No further view is swept once the last SWEPT_LAST views show no seed yet in a mean share of less than SWEPT_NEW of
# their pixels: `lego` and `fox` need 8 views, `redkitchen` without depth 14.
SWEPT_LAST, SWEPT_NEW = 4, 0.05
SWEPT_PIXELS = 20_000  # pixels of an image that is matched as it is; larger ones are matched smaller
SWEPT_STEPS = 64  # inverse depths, from 0
SWEPT_NEAR = 0.3  # nearest depth, share of the distance to the scene
SWEPT_WITH = 4  # other views that a view is compared with
SWEPT_ANGLES_DEG = 1.0, 5.0, 30.0  # parallax of another view: least, best, most
SWEPT_FACING, SWEPT_TURNED = 0.8, 3.0  # least cosine between two views' axes; what a turn costs in log parallax
SWEPT_BLUR_PX = 0.7  # interpolation blurs the other image about as much
CONTRAST_PX = 4.0  # standard deviation of the window by whose mean and contrast an image is normalized
CONTRAST_NOISE, CONTRAST_GAIN = 0.02, 0.2  # contrast that is noise, of 1; a deviation of one contrast becomes so much

# --- growth where the residual is large (scan_field) ---
GROW_EVERY = 10  # steps between additions of Gaussians
GROWN_ERROR = 0.08  # color error, blurred over 3 x 3 pixels, above which detail is missing
GROWN_CELLS, GROWN_DETAIL = (8, 4, 2), 0.05  # as CELLS and DETAIL, for new Gaussians
GROWN_WIDTH, GROWN_OPACITY = 0.5, 0.5  # as WIDTH and OPACITY, for new Gaussians
GROWN_MOST = 400  # new Gaussians at a time
AGREES = 0.1  # share by which measured and rendered depth differ where they are of the same surface
NEARER = 0.003  # share by which new Gaussians lie before what is rendered
PRUNE_EVERY = 100  # steps between removals of Gaussians

# --- exposures and poses (exposures, scan_field, pose_alignment) ---
EXPOSED_FROM = 31  # step from which exposures are estimated: before, the field shows no colors
TOWARDS_ONE = 0.02  # damping of the least squares towards gain 1 and bias 0, squared colors
EXPOSURE_SHARE = 0.3  # share of the way to a new estimate that is taken
GAINS, MOST_BIAS = (0.4, 2.5), 0.3  # bounds of an exposure's gain; its bias, at most to either side
GAUGE_EVERY, GAUGE_SHARE = 40, 0.04  # steps between corrections of the gauge; share of the mean shift taken back
# A view's pose is corrected in full for so many steps, then the steps get shorter: later ones follow the noise of
# single steps. A field of views that come one after the other is young where they are, and takes all in full.
FULL_STEPS = 3
MOST_DEG, MOST_SHARE = 5.0, 0.1  # largest turn of a pose; largest shift, share of the cameras' distance to the scene

# --- views that come one after the other (carried_field, keyframe_choice, reported_poses, plausibility) ---
STEPS_A_KEYFRAME = 24  # steps for each new keyframe: with fewer, new regions stay blurred; with more, they come late
# Newest keyframes of each camera, and share of the steps that they get: with more, earlier ones are forgotten.
NEWEST, NEWEST_SHARE = 4, 0.4
FRESH_STEPS = 3  # first steps, on the newest keyframe alone: in redkitchen what is shown now gains 0.8 dB
GROWN_UPTO = 0.7  # share of the Gaussians beyond which none is inserted: new places are seeded with the others
KEPT_PIXELS = 1 << 23  # pixels of all keyframes together: 60 MB with their depth
LEAST_KEPT, MOST_KEPT = 32, 400  # keyframes, whatever their size: each new one is compared with all others
KEPT_CORRECTIONS = 2048  # corrections kept of keyframes that went, for held-out and late frames of their time
# A new view's exposure is found from pixels with more opacity than the first, surfaces, and less error than the second,
# as expected.
EXPOSED_OPACITY, EXPOSED_ERROR = 0.7, 0.25
EXPOSED_SHARE = 0.2  # share of its pixels that must be such, at least
BARE = 0.05  # contrast (standard deviation) of a view that shows nothing; of redkitchen's views it is .15 and more
BEGINS = (2, 4, 8)  # numbers of keyframes without depth at which a field begins anew

# --- the pose of a new frame, by alignment with a rendering (carried_field, plausibility, pose_alignment) ---
RENDERED_HALVINGS = 1  # halvings of the size that is rendered: half is as good, the finest level has it
LEVELS = ((2, 3), (1, 3), (0, 2))  # for each level its further halvings and iterations: coarse to fine
ALIGNMENTS = 2  # renderings: the second one from where the first led
SURE = 0.9  # share of pixels that look as expected at the predecessor's correction: no need to look further
MOST_ALIGNED, LEAST_ALIGNED = 5000, 50  # pixels a level, at most and at least
ALIGNED_OPACITY = 0.5  # opacity above which a pixel shows a surface
SOFT = 0.1  # gray levels: what differs by more disagrees, and counts little
# A turn of PRIOR_RAD, or a shift of PRIOR_M, from the given pose costs as much as a squared error of PRIOR_ERROR.
PRIOR_RAD, PRIOR_M, PRIOR_ERROR = 0.02, 0.03, 1e-3
LONGEST_RAD = 0.05  # largest rotation in a step

# --- a camera located by its pictures, not its reported poses (reported_poses, and those above) ---
GUESSED_ERROR = 4e-5  # as PRIOR_ERROR, around a guess: five times as far costs as much
ENOUGH_OVERLAP = 0.6  # share of pixels in view, above which more makes a guess no better
DOUBTFUL = 0.9  # share of pixels that look as expected, below which another place than the reported one is tried
LOCATED = 0.7  # least share of pixels for another place to be believed
# Times the largest correction that a camera may move between two keyframes: more is a wrong match, or a leap.
FARTHEST = 6.0
LOST = 1  # frames in a row that are not found, after which one is taken where the one before was
DOUBTS = 2  # keyframes in a row for which another place fits better, from which on reports are not believed
LEAPT = 2  # further keyframes that fit where a leap of reported poses leads, from which on the leap is believed
ASTRAY_FOR = 4  # keyframes from which on it is said why reported poses do not fit
# Differences of rotation matrices' numbers: below the first, rotations are the same (a tracker's noise is more); above
# the second, a camera has turned.
SAME_TURN, TURNED = 1e-6, 0.05
# Corners of a picture, followed to the next keyframe: at most, at least, and the least distance of two.
CORNERS, LEAST_CORNERS, CORNERS_APART_PX = 200, 8, 3
CORNER_QUALITY = 0.01  # least quality of a corner, as a share of the best corner's
# Median by which corners move elsewhere than reported, pixels and share of the way: above, pictures contradict poses.
# Keyframes of `redkitchen`, .3 s apart, have a share of more than .2 in one of ten pairs once their turns are taken
# out, in three of four as they are.
BESIDE_PX, BESIDE_SHARE = 1.0, 0.25
# Pairs of keyframes by which more contradict an unchanged reported rotation than agree: then poses have no rotation.
UNTURNED = 6
OTHER_UNIT = 2.5  # ratio of distances that is no error of single poses: feet in meters are 3.3
UNIT_LOG = 0.45  # difference of its logarithm from that of another unit, up to which that unit is named
FOLLOWED = 0.1  # share of pixels by which fewer may look as expected where reported motion leads than at best
# Longest time between two keyframes for a leap: later the camera may be anywhere, and a fit where it was tells none.
LONGEST_LEAP_S = 1.0
FASTEST = 3.0  # times the last motion, which a camera may have made since

# --- frames and poses that cannot be right (carried_field, reported_poses, plausibility, pose_alignment) ---
# A frame is left out that has this share of the field in view, but fewer of its pixels as expected than the second.
LEAST_OVERLAP, LEAST_AGREEING = 0.3, 0.5
FLAT = 0.15  # share of the expected contrast, below which a lens is covered; an exposure of a third has 0.33
PATIENCE = 10  # frames of a camera left out in a row: then the next is taken as it is, it may be in a new place
MOVED_EVERY = 4  # pixels between those that are tested
# If an earlier frame saw further by more than this share of the depth, plus these meters, nothing was there.
MOVED_SHARE, MOVED_M = 0.1, 0.05
MOVED_LEAST = 0.005  # least share of an image's pixels where that is so: less is noise of depth
JUDGED = 24  # newest keyframes of a camera by which its poses are judged
MOUNT_POSES = 256  # newest poses by which an error of the mount is told: takes 15 ms
DRIFT_SHARE = 0.6  # share of the largest correction, above which poses drift
LATE_S, LATE_EXPLAINS = 0.03, 0.4  # least delay of poses that is told; share of the corrections that it explains
LONGEST_GAP_S = 1.5  # longest time between two keyframes from which a velocity is taken


def scan_options(pixels: int, tracked: bool) -> dict[str, Any]:
    """Options of a field for a scan. pixels: of one image. tracked: its poses come from a tracker."""
    return {"scan": True, "refine": tracked, "gaussians": min(max(int(PER_PIXEL * pixels), LEAST), MOST)}
