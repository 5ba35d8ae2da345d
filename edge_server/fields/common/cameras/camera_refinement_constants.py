"""Numbers of the corrections of cameras, each tuned once on recorded footage. None is an option."""

from __future__ import annotations

import numpy as np

# --- poses, corrected by the pixels that a field renders: ``PoseCorrections.correct`` (pose_corrections) ---
PIXELS = 384  # pixels that are compared
STEP_SHARE, LONGEST = 0.8, 1.0  # share of a Gauss-Newton step that is taken; its bound in each parameter, pixels
PRIOR = 1e-2  # squared error that a correction at its bound costs: without detail, poses stay as given
OUTLIER = 0.15  # residual of a color from which on a pixel counts less: something moved, or is hidden

# --- poses, corrected by a gradient: ``PoseCorrections.descend`` (pose_corrections) ---
FARTHEST = 1.0  # longest step in a parameter, pixels
# DAMPING is the squared error that a step of USUAL costs (three shifts in meters, three rotations in radians): what an
# image hardly tells apart stays as it is.
DAMPING, USUAL = 1e-3, np.array([0.03] * 3 + [0.02] * 3)
# SPREAD is the share of a step that the next view in time makes too, the one after it that share of it again, and so on
# for REACH views: errors of tracking vary slowly, and a fit of some seconds looks at each view but a few times.
SPREAD, REACH = 0.8, 8

# --- what all corrections of a camera have in common (mount_error) ---
PARTS = 8  # parts of the path, each left out in turn (jackknife)
LEAST_POSES = 2 * PARTS  # fewest poses from which anything in common is told
# Standard errors, and root mean square errors of single poses, from which on a hint is given: refined in tiny images,
# exact poses have as much in common as they scatter by.
SURE, STANDS_OUT = 2.0, 1.5
# Distances at which a turn and a shift may undo each other, meters, and the share of the shift that may be left: drift
# of 60 s and 270 s of `redkitchen` cancels 2.0 to 2.2 m ahead, and leaves .18 to .31.
CANCELS_M, CANCELS = (0.3, 20.0), 0.5
# Least variance of directions as the camera sees them, of all axes, from which on a correction of the camera is told
# from one of the world: .1 are turns of 18 degrees to either side, about two axes. `redkitchen` after 8 s has .006,
# and its corrections are split into 2.2 degrees of the camera and 1.5 back of the world.
TOLD = 0.1
COMMON_PRIOR = 0.01  # share of the largest singular value added for the camera: what is not told is left to the world

# --- poses and appearances of fields that render rays (appearance, camera_refinement) ---
START = 40  # steps before anything is corrected: first the scene must take shape
EVERY = 2  # steps between corrections of a pose, of one camera after the other
APPEARANCE_FIRST = 0.3  # standard deviation of first values: from 0 the network would get no gradient
APPEARANCE_RATE, APPEARANCE_EPSILON = 2e-2, 1e-4  # of Adam: learning rate and epsilon
APPEARANCE_MOST = 3.0  # bound of every number's absolute value
