"""TensoRF: vector-matrix factors (Chen et al. 2022)."""
