"""The synthetic world: analytic scenes with exact ground truth at any instant."""

from camera_node.synthetic.scene import SCENES, Scene, make_scene

__all__ = ["SCENES", "Scene", "make_scene"]
