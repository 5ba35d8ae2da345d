"""Numbers of a scan's field, tuned once on recorded footage. None is an option; ``scan_options`` says which options a
data set asks for."""

from __future__ import annotations

from typing import Any

# --- rates: no schedule, so that a fit may go on for as long as it likes ---
SETTLE_STEPS = 80  # of a Gaussian at full rates, then they fall as 1 / steps
POSITION_PX, COLOR = 0.2, 0.012  # lower than where things move: seeds lie on surfaces already
DISSIMILARITY = 0.02  # weight of (1 - SSIM) / 2 in the loss; three times as much raises SSIM and costs PSNR

# --- how many Gaussians ---
# Options of a carried camera's field, live, where a scenario says nothing; few pixels bound the Gaussians further.
LIVE_OPTIONS: dict[str, Any] = {"scan": True, "refine": True, "carried": True, "gaussians": 60_000}
PER_PIXEL = 0.78  # of one image, at most; more cost time in every step, and sharpen little
LEAST, MOST = 8192, 1 << 18  # whatever the images; the most take 60 MB, and steps of a tenth of a second
NEAR_SHARE = 0.1  # of the cameras' distance to the scene: a near plane for cameras that are carried close to things

# --- seeds from measured depth ---
SEED_VIEWS = 60  # from at most so many views: the others see hardly anything new
LEAST_SIDE = 5  # pixels of an image: normals come from differences over so many
CELLS = (16, 8, 4)  # pixels a side of a quadtree's leaves
DETAIL = 0.06  # standard deviation of a leaf's color, over channels, above which it is divided
MIXED = (0.01, 0.75)  # shares of a leaf's pixels between which it is divided; below the first it is left out
COVERED = 0.6  # opacity above which a pixel shows a surface
BEHIND_SHARE, BEHIND_M = 0.07, 0.02  # what is shown lies behind what is measured by more: the nearer is missing
DEPTH_M = 1e-3, 1e4  # what lies beyond was measured by nothing; NaN is neither
JUMP_SHARE, JUMP_M = 0.05, 0.02  # depth that spans more within 3 x 3 pixels is of two surfaces, or of none
WIDTH, FLATNESS, OPACITY = 0.6, 0.2, 0.8  # a seed's standard deviation in sides of its leaf, and thickness in that
STEEPEST = 0.3  # least cosine to the view: nothing is stretched along a surface further than this says
GUESSED_OPACITY = 0.5  # of seeds at a depth that is guessed

# --- depth by plane sweep, where none is measured (sweep); found on redkitchen, against its depth camera ---
SWEPT_VIEWS = 40  # from at most so many
# Mean share of the last so many views' pixels that show no seed yet, below which no further view is swept: `lego` and
# `fox` need 8 views, `redkitchen` without depth 14.
SWEPT_LAST, SWEPT_NEW = 4, 0.05
SWEPT_PIXELS = 20_000  # of an image that is matched as it is; larger ones are matched smaller
SWEPT_STEPS = 64  # inverse depths, from 0
SWEPT_NEAR = 0.3  # nearest depth, share of the distance to the scene
SWEPT_WITH = 4  # other views
SWEPT_ANGLES_DEG = 1.0, 5.0, 30.0  # parallax of another view: least, best, most
SWEPT_FACING, SWEPT_TURNED = 0.8, 3.0  # least cosine between two views' axes; what a turn costs in log parallax
SWEPT_BLUR_PX = 0.7  # interpolation blurs the other image about as much
CONTRAST_PX = 4.0  # standard deviation of the window by whose mean and contrast an image is normalized
CONTRAST_NOISE, CONTRAST_GAIN = 0.02, 0.2  # contrast that is noise, of 1; a deviation of one contrast becomes so much

# --- growth where the residual is large ---
GROW_EVERY = 10  # steps
GROWN_ERROR = 0.08  # color error, blurred over 3 x 3 pixels, above which detail is missing
GROWN_CELLS, GROWN_DETAIL = (8, 4, 2), 0.05
GROWN_WIDTH, GROWN_OPACITY = 0.5, 0.5
GROWN_MOST = 400  # a time
AGREES = 0.1  # share by which measured and rendered depth differ where they are of the same surface
NEARER = 0.003  # share by which new Gaussians lie before what is rendered
PRUNE_EVERY = 100  # steps

# --- exposures and poses ---
EXPOSED_FROM = 31  # step, from which exposures are estimated: before, the field shows no colors
TOWARDS_ONE = 0.02  # damping of the least squares towards gain 1 and bias 0, squared colors
EXPOSURE_SHARE = 0.3  # of the way to a new estimate
GAINS, MOST_BIAS = (0.4, 2.5), 0.3
GAUGE_EVERY, GAUGE_SHARE = 40, 0.04  # steps between corrections of the gauge; share of the mean shift taken back
# Steps of a view's pose after which they get shorter: later ones follow the noise of single steps. A field of views
# that come one after the other is young where they are, and takes all in full.
FULL_STEPS = 3
MOST_DEG, MOST_SHARE = 5.0, 0.1  # largest correction of a pose; share of the cameras' distance to the scene


# --- views that come one after the other ---
STEPS_A_KEYFRAME = 24  # with fewer, new regions stay blurred; with more, they come late
NEWEST, NEWEST_SHARE = 4, 0.4  # steps on the newest keyframes: with more, earlier ones are forgotten
FRESH_STEPS = 3  # the first ones, on the newest keyframe: in redkitchen what is shown now gains 0.8 dB
GROWN_UPTO = 0.7  # share of the Gaussians beyond which none is inserted: new places are seeded with the others
KEPT_PIXELS = 1 << 23  # of all keyframes together: 60 MB with their depth
LEAST_KEPT, MOST_KEPT = 32, 400  # keyframes, however large or small: each new one is compared with all others
KEPT_CORRECTIONS = 2048  # of keyframes that went, for held-out and late frames of their time
EXPOSED_OPACITY, EXPOSED_ERROR = 0.7, 0.25  # pixels from which a new view's exposure is found: surfaces, as expected
EXPOSED_SHARE = 0.2  # of its pixels, at least
BARE = 0.05  # contrast (standard deviation) of a view that shows nothing; of redkitchen's views it is .15 and more
BEGINS = (2, 4, 8)  # numbers of keyframes without depth at which a field begins anew


# --- the pose of a new frame, by alignment with a rendering ---
RENDERED_HALVINGS = 1  # half the size is as good: the finest level has it
LEVELS = ((2, 3), (1, 3), (0, 2))  # further halvings, and iterations: coarse to fine
ALIGNMENTS = 2  # renderings: the second one from where the first led
SURE = 0.9  # share of pixels that look as expected at the predecessor's correction: no need to look further
MOST_ALIGNED, LEAST_ALIGNED = 5000, 50  # pixels a level
ALIGNED_OPACITY = 0.5  # above which a pixel shows a surface
SOFT = 0.1  # gray levels: what differs by more disagrees, and counts little
PRIOR_RAD, PRIOR_M, PRIOR_ERROR = 0.02, 0.03, 1e-3  # so far from the given pose costs as much as that squared error
LONGEST_RAD = 0.05  # rotation a step

# --- a camera whose reported poses do not fit its pictures: it is located by them ---
GUESSED_ERROR = 4e-5  # as PRIOR_ERROR, around a guess: five times as far costs as much
ENOUGH_OVERLAP = 0.6  # guesses that have more in view are as good
DOUBTFUL = 0.9  # share of pixels that look as expected, below which another place than the reported one is tried
LOCATED = 0.7  # least share of pixels for another place to be believed
FARTHEST = 6.0  # largest corrections, that a camera may move between two keyframes: more is a wrong match, or a leap
LOST = 1  # frames in a row that are not found, after which one is taken where the one before was
DOUBTS = 2  # keyframes in a row for which another place fits better, from which on reports are not believed
LEAPT = 2  # further keyframes that fit where a leap of reported poses leads, from which on it is believed
ASTRAY_FOR = 4  # keyframes from which on it is said why reported poses do not fit
SAME_TURN, TURNED = 1e-6, 0.05  # of matrices' numbers: a tracker's noise is more; a camera that turns
CORNERS, LEAST_CORNERS, CORNERS_APART_PX = 200, 8, 3  # of a picture, followed to the next keyframe
CORNER_QUALITY = 0.01  # of one, least share of the best corner's
# Median by which they move elsewhere than reported, pixels and share of the way. Keyframes of `redkitchen`, .3 s apart,
# have a share of more than .2 in one of ten pairs once their turns are taken out, in three of four as they are.
BESIDE_PX, BESIDE_SHARE = 1.0, 0.25
UNTURNED = 6  # by so many pairs of keyframes contradict reported poses more than agree: then no rotation is said
OTHER_UNIT = 2.5  # ratio of distances that is no error of single poses: feet in meters are 3.3
UNIT_LOG = 0.45  # deviation of its logarithm, up to which it is that of two units
FOLLOWED = 0.1  # share of pixels by which fewer may look as expected where reported motion leads than at best
# Between two keyframes, for a leap: later the camera may be anywhere, and what fits where it was tells no leap.
LONGEST_LEAP_S = 1.0
FASTEST = 3.0  # times that the last motion may have gone on since

# --- frames and poses that cannot be right ---
LEAST_OVERLAP, LEAST_AGREEING = 0.3, 0.5  # with this much of the field in view, fewer pixels as expected: left out
FLAT = 0.15  # of the contrast that is expected, less is that of a covered lens; an exposure of a third has 0.33
PATIENCE = 10  # frames of a camera left out in a row: then the next one is taken as it is, it may be in a new place
MOVED_EVERY = 4  # pixels between those that are tested
MOVED_SHARE, MOVED_M = 0.1, 0.05  # an earlier frame saw further by more: nothing was there
MOVED_LEAST = 0.005  # share of an image: less is noise of depth
JUDGED = 24  # newest keyframes of a camera by which its poses are judged
MOUNT_POSES = 256  # newest ones by which an error of the mount is told: 15 ms
DRIFT_SHARE = 0.6  # of the largest correction, above which poses drift
LATE_S, LATE_EXPLAINS = 0.03, 0.4  # least delay of poses that is said, and share of the corrections that it explains
LONGEST_GAP_S = 1.5  # between two keyframes, for a velocity


def scan_options(pixels: int, tracked: bool) -> dict[str, Any]:
    """Options of a field for a scan. pixels: of one image. tracked: its poses come from a tracker."""
    return {"scan": True, "refine": tracked, "gaussians": min(max(int(PER_PIXEL * pixels), LEAST), MOST)}
