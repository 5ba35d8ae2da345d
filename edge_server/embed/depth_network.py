"""A monocular depth network of the user's, run by ONNX Runtime: an image -> relative inverse depth.

The form is that of Depth Anything V2 (Yang et al., 2024). Input: RGB images (1, 3, height, width) of float32 or
float16, normalized by ImageNet's mean and deviation, sides multiples of 14. Output: (1, height, width) or
(1, 1, height, width), larger where nearer; its scale and shift differ from image to image. The scenario key
``edge.depth_network`` names the file, which may come from anywhere; without that key this module is not imported.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server import edge_constants as tuned
from edge_server.embed import EmbeddingError
from edge_server.embed.embedder import INPUT_TYPES, open_model, reason_of
from edge_server.embed.letterbox import checked

MEAN, DEVIATION = np.array(
    [[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]], np.float32
)  # of ImageNet, channels in [0, 1]
PATCH = 14  # pixels a side of what DINOv2, its encoder, takes as one token
SIDE = 518  # shorter side of the images it was trained on


class DepthNetwork:
    """Call it with an image. Raises EmbeddingError, when made and when called.

    name: of the file.
    """

    def __init__(self, file: Path) -> None:
        self.name = file.name
        self._session = open_model(file)
        inputs = self._session.get_inputs()
        shape = inputs[0].shape if len(inputs) == 1 else []
        right = len(shape) == 4 and (shape[1] == 3 or not isinstance(shape[1], int))  # a name: any number of channels
        if not right or inputs[0].type not in INPUT_TYPES:
            raise EmbeddingError(f"{file}: expected a model of images (1, 3, height, width) of float32 or float16")
        self._input, self._type = inputs[0].name, INPUT_TYPES[inputs[0].type]
        self._fixed = [side if isinstance(side, int) else 0 for side in shape[2:]]
        most = tuned.MAX_MODEL_SIDE_PX
        if max(self._fixed) > most:
            raise EmbeddingError(f"{file}: images of {self._fixed} pixels are larger than {most} a side")
        self(np.zeros((PATCH, PATCH, 3), np.uint8))  # a model that cannot run, or gives something else, fails here

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Relative inverse depth, float32 (H, W), NaN where the model gives no number. image: uint8 RGB (H, W, 3)."""
        whole = checked(image, 0)
        height, width = self._size(*whole.shape[:2])
        fitted = cv2.resize(whole, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.float32) / 255.0
        given = ((fitted - MEAN) / DEVIATION).transpose(2, 0, 1)[None].astype(self._type)
        try:
            found = np.asarray(self._session.run(None, {self._input: given})[0])
        except Exception as error:  # ONNX Runtime's exceptions share no base class
            raise EmbeddingError(f"{self.name}: {reason_of(error)}") from None
        if found.shape not in ((1, height, width), (1, 1, height, width)):
            raise EmbeddingError(
                f"{self.name}: an image of {height} x {width} gave {found.shape}, not an inverse depth for each pixel; "
                "name a model of Depth Anything V2's form"
            )
        sound = np.where(np.isfinite(found), found, np.nan).astype(np.float32).reshape(height, width)
        return np.asarray(cv2.resize(sound, whole.shape[1::-1], interpolation=cv2.INTER_LINEAR), np.float32)

    def _size(self, height: int, width: int) -> tuple[int, int]:
        """Height and width of the model's input for an image."""
        most = tuned.DEPTH_MOST_ASPECT * min(height, width)
        scale = SIDE / (min(height, width) * PATCH)
        free = [PATCH * max(1, round(scale * min(side, most))) for side in (height, width)]
        return self._fixed[0] or free[0], self._fixed[1] or free[1]
