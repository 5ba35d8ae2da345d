"""An extension of griffe, which reads the docstrings for the reference."""

from __future__ import annotations

import re
from typing import Any

import griffe


class DocstringLines(griffe.Extension):
    """Begins a paragraph at each line that tells of an argument, because Markdown would join them:

    image: uint8 (H, W, 3).
    depth: float32 (H, W), meters.
    """

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called by griffe for each object that it has read."""
        if obj.docstring:
            obj.docstring.value = re.sub(r"\n(?=[\w, ]+: )", "\n\n", obj.docstring.value)
