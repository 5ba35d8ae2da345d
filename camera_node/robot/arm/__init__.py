"""A UR arm that carries a camera: joint states, kinematics, camera poses, viewpoint tours."""
