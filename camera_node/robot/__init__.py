"""Camera nodes on a robot arm: driver, kinematics, simulated controller, calibration, teleoperation."""
