"""Hand-eye calibration: where a camera sits on an arm (thesis 4.3)."""
