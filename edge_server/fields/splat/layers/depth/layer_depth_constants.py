"""Numbers of the layers where cameras measure depth, tuned on `room` with a simulated stereo sensor."""

from __future__ import annotations

# --- plates (body_depth, depth_plate, depth_supervision, virtual_plates, kernels.body_depth, kernels.depth_plate) ---
# Depth is kept as its inverse, in which a plane is linear in the image and the noise of a stereo camera is even.
# A stereo sensor's disparity in pixels is this times inverse depth: 425 px focal length, .05 m baseline (RealSense
# D400 at 848 x 480). Bounds below are disparities of such a sensor.
_DISPARITY_PX_M = 21.25
KEPT = 15  # depths a pixel remembers: a second of frames at 15 a second
LEAST = 3  # fewest depths of a pixel that make its median known
LOOKED_AT, LEAST_LOOKED_AT = 3, 12  # each so many-th pixel tells whether an image contradicts the plate; fewest of them
ALIKE = 0.75  # ratio of two depths, down to which they do not contradict: sensors err by less
# Images in a row that are refused: a sensor that was set to another unit is believed again, after 15 s of each fifth
# frame.
MOST_REFUSED = 45
# 1 / m: two thirds of a pixel's depths lie this near their median, or the pixel flies between two surfaces.
STEADY = 0.4 / _DISPARITY_PX_M
RADIUS = 3  # pixels, of the window in which a plane is fitted
SPREAD_PX = 2.1  # standard deviation of the window's Gaussian
ROUNDS = 3  # rounds of reweighting
NOISE = 0.12 / _DISPARITY_PX_M  # 1 / m: a neighbor so far off the plane counts half
OUTLIER = 2.5  # times NOISE, beyond which a neighbor does not count
# Known pixels among 3 x 3, and times NOISE: the median of fewer pixels does not count if it is further off.
LONE, LONE_NOISES = 4, 4.0
LEAST_WEIGHT = 0.5  # least weight of a window's pixels together that makes a plane; a pixel in full counts 1
LEVEL = 0.05  # share of the weight, squared pixels, by which planes are kept level where nothing tells their slope
HOLE_LEAST = 0.5  # share of the neighbor's inverse depth, below which its plane does not continue into a hole
SMOOTH_COLOR = 30.0  # of 3 x 255: a neighbor whose color differs so much counts half
HOLE_PX = 3  # pixels without depth as near as this to some take over a neighbor's plane
HOLE_COLOR = 12.0  # of 255: a difference of color that counts as much as 4 pixels of distance
HOLE_NEAR = 0.25  # what a pixel of distance counts, where HOLE_COLOR counts 1
HOLE_MOST = 2.0  # times HOLE_COLOR, color and distance together, above which a neighbor's plane is not taken over

# --- surfaces between the cameras (overlaps, registration, surfaces, virtual_plates, kernels.surfaces) ---
NEAREST_M = 0.05  # what is nearer to a camera is not drawn
CUT = 0.012  # 1 / m: a mesh is cut where inverse depth jumps by more, off the slopes at both sides
STRETCH = 400.0  # a triangle whose longest side squared is so many times its area is seen at too grazing an angle
MIXED = 0.08  # trust in pixels beside a cut: they mix two surfaces
AGREE = 0.03  # relative difference of depth at which two surfaces half agree
SAME_SURFACE = 1.5  # times AGREE: cameras whose depth differs by less show one surface
LEAST_TRUST = 0.01  # agreement, weighted by trust, of a camera with a point, below which it tells nothing of it
# How sure an agreement is, from 0 to 1: this times the number of cameras that agree, each counted up to 1 by how well
# it agrees and by its trust. Half a camera's agreement is enough.
ENOUGH = 2.0
SEEN_THROUGH = 0.3  # times its agreement: how sure a surface is that cameras see through, if no other is found
THROUGH = 2.5  # times AGREE: a camera that measures a depth so much larger sees through a point
# A surface does not count if more cameras see through it than REJECT times those that agree, plus REJECT_LEAST.
REJECT, REJECT_LEAST = 0.6, 0.4
FORWARD = 3.0  # how much more a camera counts whose direction is like the view's, in the exponent of a cosine
LEAST_FACING = 0.02  # cosine at which a surface counts as facing a camera, at least
BEHIND = 0.03  # share of a measured depth by which a Gaussian may lie behind it and still be of that surface

# --- virtual plates (depth_supervision, surfaces, virtual_plates) ---
VIRTUAL_PLATES = 12  # plates, drawn from places between the cameras
MARGIN_DEG = 20.0  # by which plates' directions are spread wider than the cameras'; half of it downwards
# Weight in training of pixels that no camera sees, and a factor on that of pixels beside silhouettes: with 0 there,
# `quad` shows .4 dB less than with 1, with .1 .2 dB more; a recorded kitchen before four cameras .4 and .6 dB more
# (seed 7, on which it was chosen; with seed 8 0 and .2).
UNSEEN_WEIGHT = 0.1
SILHOUETTE_SHARE = 64  # of the width: silhouettes count as at most so wide, and as narrow as RADIUS
# Share of the plates without depth: above it that weight is 0, as cameras may see what is there, and stereo fills.
MOST_HOLES = 0.06
FADE_PX = 16.0  # in an image 128 pixels wide: so far from what is seen, colors are the mean's by 1 - 1 / e
SURE = 0.3  # agreement above which a pixel counts as seen

# --- first Gaussians (first_gaussians) ---
# Standard deviation in distances to their neighbors; that across the surface, as a share of it.
FIRST_SIZE, FIRST_THICKNESS = 0.5, 0.2
FIRST_OPACITY = 0.5  # of the first Gaussians

# --- what cameras see of one another (overlaps, registration) ---
OVERLAP_POINTS = 1024  # points of one camera that are looked for in others
OVERLAP_LEAST = 50  # points that two cameras must share to say anything
# Half of a camera's depths lie between these, times the distance to where the cameras look: else they are of another
# unit. The second: with less between any two cameras' directions, that place is not certain.
RANGE, LEAST_ANGLE_DEG = (0.25, 6.0), 30.0
CONTRADICTS = 0.12  # relative difference of depths; poses and scales that registration can correct stay below
LEAST_AGREE = 0.5  # share of the shared points that agree, below which a camera's depth is left out
# Weight, in that share, of points behind what the other camera measures: those may be hidden, but not nearly all.
HIDDEN_WEIGHT = 0.1

# --- depth of what moves (body_depth, kernels.body_depth, layers.layered_field) ---
# Foreground is wider than what moves, and holds its shadow: what moves differs from the plate by more than the first
# (of 255), and is nearer by the second in meters, and by the third as a share of the plate's depth.
BODY_OFF_PLATE, BODY_NEARER_M, BODY_NEARER = 16.0, 0.1, 0.03
# Depth measured longer before or after its image tells nothing of what moves: at 1 m / s it is 5 cm off, about as much
# as BODY_THROUGH_M. What stands still is learned from it all the same.
BODY_GAP_NS = 50_000_000
BODY_RADIUS_PX = 2  # around a pixel: these pixels' median says whether it was measured well, their mean its depth
BODY_LEAST = 4  # fewest of them that must have measured
BODY_FLYING = 0.5 / _DISPARITY_PX_M  # 1 / m: a pixel farther from the median flies between two surfaces
BODY_PIXELS = 8  # fewest pixels with depth of what moves, of all frames together, from which Gaussians are seeded
BODY_AGE_S = 0.25  # age of the oldest frame from whose depth they are seeded
BODY_WRONG = 0.1  # color error, in the worst channel, above which a pixel seeds a Gaussian
BODY_SEED_PX, BODY_OPACITY = 0.8, 0.6  # standard deviation of a seeded Gaussian in pixels, and its opacity
# Depth that lies farther behind a Gaussian than their sum (the second is a share of the distance) sees through it.
BODY_THROUGH_M, BODY_THROUGH = 0.06, 0.02

# --- when what begins (depth_supervision, plate_stereo, layers.static_supervision) ---
PLATE_S = 0.6  # time before plates are certain, where most of the cameras have depth
SHOWN_AFTER = 50, 200  # steps after which the first field, and one that began anew, is shown
CHANGED_SHARE = 0.01  # share of the pixels: if more depths are new or have changed, the still field learns again

# --- registration of the cameras to one another (registration) ---
REGISTERED_POINTS = 4096  # points of a camera that are placed before the others
REGISTRATION_ROUNDS = 8  # rounds of Gauss-Newton
# Standard deviations of calibrated poses (a turn, a shift), and of the logarithm of a sensor's scale.
TURN_DEG, SHIFT_M, LOG_SCALE = 0.25, 0.004, 0.006
# Corrections are held back by a prior with these deviations. A correction this many deviations large is held half as
# tightly as a small one (a Cauchy prior): a bumped camera is far off.
PRIOR_DEVIATIONS = 3.0
# Largest change of a scale's logarithm in one round; corrections, in deviations, below which no round follows.
LARGEST_LOG_SCALE, SETTLED = 0.3, 0.01
REGISTERED_M = 3.0  # distance of cameras to the scene, `room`'s, for which they hold where no camera measures depth
NEAR_M, NEAR_AT_FIRST = 0.06, 2.0  # distance along the normal at which a point counts a quarter; times this at first
NEAR_MOST = 4.0  # times NEAR_M, beyond which a point does not count
LEAST_ALIKE, REGISTERED_FACING = 0.7, 0.15  # cosines of two normals, and of a normal and the direction to the camera
DEPTH_NOISE, DEPTH_NOISE_M = 0.006, 0.004  # deviation of a smoothed depth: share of the distance, plus this
NEAR_GRAY, GRAY_NOISE = 0.08, 0.03  # as NEAR_M, but a difference of brightness in [0, 1]; its standard deviation
GRAY_BLUR_PX = 0.8  # blur of the images that are compared
GRAY_WEIGHT = 0.15  # weight of a difference of brightness
ERR_ALIKE = 25.0  # pixels that count as one: neighbors err alike
# Mean robust cost by which brightness must agree better, where stereo has found the depth: four cameras of `room` gain
# .0009 with exact poses, which then stay, and .0017 to .011 with those of a calibration. And the focal length of those
# cameras, pixels: of six exact cameras of 69 pixels, .0017 would be gained, and .5 dB lost.
STEREO_GAIN, STEREO_FOCAL_PX = 1e-3, 102.0
LARGE_TURN_DEG, LARGE_SHIFT_M, LARGE_LOG_SCALE = 1.0, 0.03, 0.025  # corrections above any of these are reported

# --- stereo of plates, where cameras measure none; found on `room` and on a recorded kitchen (plate_stereo) ---
SWEEP_NOISE = 0.5  # steps: as NOISE, of what stereo finds
SWEEP_STEPS = 128  # inverse depths, from 0: more find finer depth, but also more that is wrong
SWEEP_NEAR = 0.3  # nearest depth, share of the cameras' distance to the scene
SWEEP_PIXELS = 1 << 15  # pixels of a plate that is matched as it is: more find no better depth (`room` at 320 x 320)
SWEEP_LEAST_PX = 8.0  # least parallax over all steps: two cameras at one place tell nothing
SWEEP_FAR_PX = 1.0  # parallax at the farthest depth that another camera can confirm
SWEEP_BLUR_PX = 0.7  # interpolation blurs the other image about as much
SWEEP_AGREE = 0.05  # difference of log depth at which another camera confirms
SWEEP_TRUSTED = 0.5  # least share of what stereo finds that sensors, where they measure, must confirm as far as that
SWEEP_LEAST = 0.15  # least share of the plates whose depth stereo finds: .36 with two cameras of `room`
SWEEP_ELSEWHERE = 8e-3  # as SAME_POSE: depth found at a pose that far off is forgotten; calibrations err less

# --- large planes, by which stereo's depth is continued; found on `room` (large_planes) ---
PLANES = 6  # planes of the scene, at most
PLANE_POINTS, PLANE_DRAWS = 2048, 64  # points of a camera that are looked at; points whose planes are tried
# A point is on a plane up to this distance, as a share of the median one, and down to this cosine of normals.
PLANE_NEAR, PLANE_ALIKE = 0.03, 0.8
PLANE_LEAST = 0.02  # share of the points on it: a side wall that two of four cameras see has .04
PLANE_BEHIND = 0.05  # share of the points behind it: nothing lies behind a wall, but much behind a table

# --- a depth network of the user's (network_depth) ---
NETWORK_LEAST = 150  # fewest pixels of a plate that must have another depth: fewer may lie on one small thing
NETWORK_COLOR = 30.0  # of 255: what another camera knows is taken for a pixel whose color differs by less
NETWORK_POINTS = 4096  # points whose depths are compared
NETWORK_LINES = 512  # candidates for scale and shift, each through two of those points
# Difference of log depth up to which two depths agree; what the publishers give for V2 small is .05 (NYU-D) to .08
# (KITTI).
NETWORK_AGREE = 0.1
NETWORK_TRUSTED = 0.6  # least share that must agree: of a wall's depth half would also agree with one constant
# Share that agrees, from which on stereo that the network contradicts is taken for wrong: of `room` up to a fifth is.
NETWORK_BETTER = 0.75
NETWORK_NEAR = 0.15  # difference of log depth up to which the network does not contradict
NETWORK_SPREAD = 0.06  # share of the image's width within which the network's errors are taken to be alike
NETWORK_BEYOND = 1.5  # factor by which the network is believed beyond the nearest and the farthest known depth
NETWORK_KNOWN = (1.0, 99.0)  # percentiles of the known depths that are taken for the nearest and the farthest
NETWORK_NOISE = 0.015  # as NOISE, share of the median inverse depth
