"""The shell of a square room: four walls, floor and ceiling, each visible from inside only."""

from __future__ import annotations

from camera_node.synthetic.placement import Part, facing
from camera_node.synthetic.shapes import Quad
from camera_node.synthetic.textures import Texture


def room_shell(
    half_m: float, height_m: float, walls: dict[str, Texture], floor: Texture, ceiling: Texture, glow: float
) -> list[Part]:
    """Parts of a room of ``2 half_m`` by ``2 half_m`` by ``height_m``, centered above the origin.

    walls: textures of the north (+y), west, east and south walls. glow: of the ceiling.
    """
    h, middle = half_m, height_m / 2
    x, y, up = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    left, back = (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0)
    placed = {
        "north": (x, (0, h, middle)),
        "west": (y, (-h, 0, middle)),
        "east": (left, (h, 0, middle)),
        "south": (back, (0, -h, middle)),
    }
    wall, flat = Quad((h, middle)), Quad((h, h))
    return [
        *(
            Part(wall, walls[side], facing(along, up, center), casts_shadow=False)
            for side, (along, center) in placed.items()
        ),
        Part(flat, floor, facing(x, y, (0, 0, 0)), casts_shadow=False, takes_contact=True),
        Part(flat, ceiling, facing(x, left, (0, 0, height_m)), casts_shadow=False, glow=glow),
    ]
