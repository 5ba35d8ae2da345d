"""A UR arm that carries a camera: joint states, kinematics, camera poses, viewpoint tours."""


class ArmError(ValueError):
    """An arm that cannot be used, or a file, posture or stylus of one. The message is one line: what, where, what to
    do."""
