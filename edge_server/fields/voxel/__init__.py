"""An explicit voxel grid (as Plenoxels, Fridovich-Keil et al. 2022)."""
