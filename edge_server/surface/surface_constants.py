"""Numbers of surfaces and meshes, each tuned once. None is an option."""

from __future__ import annotations

import numpy as np

# --- depth maps (depth, reconstruct) ---
SOLID = 0.8  # minimum opacity of a ray that hits a surface
EMPTY = 0.1  # maximum opacity of a ray that hits nothing
EMPTY_TRUST = 0.25  # trust of a pixel whose ray hits nothing; 1 is a surface at normal incidence
MAX_DEPTH_M = 1e6  # larger depths are invalid
STEEPEST_DEG = 80.0  # maximum angle between ray and normal; beyond it, a pixel is an edge, or unreliable
GUESS = 0.5  # minimum opacity of a surface as initial depth for refinement
FINEST = 512  # maximum voxels along the longest side without a given voxel size

# --- sharpening by photo-consistency (reconstruct, refine_depth, kernels.patch_match) ---
SHARPENED_PIXELS = 10_000_000  # pixels of all maps that are sharpened: seven minutes of processor time, 41 s a million
COVERING_POINTS = 200  # points of a map, by which is chosen what to sharpen
SEEN_AGAIN = 0.5  # weight of a point for each chosen map that sees it already
REACH = 0.18  # how far to each side depth is searched, as a share of the initial depth
GAIN_POINTS, LEAST_SHARED = 500, 50  # points of an image; fewest that two must share to compare brightness
GAIN_WITHIN = 0.05  # tolerance of the initial depth, share of the distance
SAME_GAIN, MOST_GAIN = 0.03, 0.7  # logarithms of the least and the largest correction of brightness
SMOOTH_PX = 2.5  # sigma of the Gaussian blur for initial normals
CONFIRMED = 0.004  # tolerance of another map's surface, share of the distance, plus one pixel
CHEAP, DEAR = 0.3, 1.2  # trust falls from 1 to 0 between these costs of a plane
# Trust of a plane by the maps that confirm it: the first number, plus the second for each map, at most 1.
CONFIRMED_FIRST, CONFIRMED_EACH = 0.4, 0.2
THROUGH = 2.0  # times the tolerance CONFIRMED: a map that sees farther than a plane by more contradicts it
UNSURE = 0.05  # factor of the trust of a pixel whose depth the images do not determine
PLAIN = 0.0005  # rise of the cost a pixel's width away, below which the images hardly determine the depth
NOTHING = 1e-5  # the same rise, below which they do not determine it at all, and the field's depth stays

# --- the search for planes by PatchMatch (refine_depth, kernels.patch_match) ---
# The passes, each over all maps: whether the images that a pixel is compared with are chosen anew; number of random
# planes; ranges of random changes, of the depth as a share of it and of the normal; weight of the geometric term.
SEARCHES = (
    (True, 4, 0.02, 0.4, 0.0),
    (False, 4, 0.02, 0.4, 0.0),
    (True, 4, 0.01, 0.3, 0.0),
    (False, 2, 0.005, 0.2, 0.0),
    (True, 0, 0.005, 0.2, 0.1),
    (True, 0, 0.002, 0.1, 0.1),
)
SMALLER = 0.25  # factor on these ranges for the second half of the random changes
SOURCES = 5  # images that a pixel is compared with
# An image counts in that choice by the first times the cosine at which it sees the surface, up to 1, and by the second
# at least.
FACING, FACING_LEAST = 2.0, 0.2
SIMILAR = np.float32(15.0)  # gray levels: a tap this different weighs 1/e, so patches end at edges
FADE = 0.1  # a tap's weight falls by exp(-FADE pixels^2)
NOISE = np.float32(1.0)  # variance of gray levels, of what is no texture
DIFFERENCE = np.float32(0.8)  # share of gray levels' difference in the cost; the rest is 1 - correlation
LEVELS = np.float32(4.0)  # mean difference, gray levels, that costs 1 on a plain patch
MOST_LEVELS = np.float32(2.0)  # largest cost of such a difference
WORST = np.float32(3.0)  # cost of a plane that no other image shows
SINGLE = np.float32(0.3)  # cost that is added if only one other image shows a plane
MOST_PX = 3.0  # largest distance that the geometric term counts
LEAST_COS = 0.1  # least cosine between ray and normal
SMOOTH = np.float32(0.06)  # weight of the distance, pixels, to what neighbors' planes say
BUMPY_PX = 2.0  # largest distance, pixels, that counts so
BETTER = np.float32(1e-4)  # a plane replaces another if it is cheaper by this
# Angle between two images' lines of sight: least; best; standard deviation of the preference around that; most.
LEAST_DEG, BEST_DEG, SPREAD_DEG, MOST_DEG = 3.0, 25.0, 15.0, 70.0

# --- fusion and meshes (mesh, reconstruct, sdf, volume, kernels.fuse) ---
MIN_WEIGHT = 0.2  # least weight of a known voxel; a camera at normal incidence counts 1
# Voxels of the box around the blocks: 512 MB of distances, and up to 3.2 GB if all lie near a surface.
MOST_VOXELS = 1 << 27
MAX_BLOCKS = 1 << 24  # entries in the table of blocks: 24 bytes each during fusion
TRUNCATION = 4.0  # voxels from a surface, beyond which distances are cut off
FREE = 0.05  # weight factor of a voxel far before a surface; 1 at the surface
CLOSE = 2.0  # maximum depth difference of neighboring pixels on one surface, in truncations
OUTLIERS = 0.002  # share of points at each end of each axis that the box leaves out
BOX_POINTS = 20_000  # points of a map, from which the box is found
MAX_NODES = 1 << 24  # nodes of the distance function's finest grid, at most
LEAST = 1e-3  # voxels, least distance; one of exactly 0 puts a vertex on a voxel and makes degenerate triangles
KEEP_SHARE = 0.002  # share of the largest component's area; smaller components are removed

# --- the distance function (sdf) ---
# Grids, each twice as fine as the last; on each, Adam's steps, samples of each kind, and learning rate in voxels.
SDF_LEVELS, SDF_STEPS, SDF_POINTS, SDF_RATE = 3, 60, 20_000, 0.1
SDF_EIKONAL, SDF_SIDES = 0.1, 1.0  # lambda of (3.15), the weight of the eikonal term; weight of the third term
# Betas of Adam; share of its learning rate that is left at the end of a grid.
SDF_BETAS, SDF_RATE_END = (0.9, 0.95), 0.1
SDF_SAYS_EVERY = 20  # steps between two reports of progress
