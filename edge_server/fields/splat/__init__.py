"""3D Gaussian splatting (Kerbl et al. 2023)."""
