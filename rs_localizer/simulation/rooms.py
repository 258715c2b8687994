"""A closed room of pictures with a few markers on its walls, which give a map of it metres."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.io.video import Image
from rs_localizer.markers.dictionaries import pattern
from rs_localizer.markers.families import family
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Marker
from rs_localizer.simulation.planes import TexturedPlane
from rs_localizer.simulation.true_motion import TrueState
from rs_localizer.simulation.walls import Scene, poster, room, three_walls

_FAMILY = "4x4_250"
# Texels along a cell of a marker: corners lie between texels, so that nothing is rounded.
_CELL_TEXELS = 14
# Where along a wall its markers hang, in shares of its width.
_PLACES = (0.3, 0.7)
_PAPER, _INK = 235, 26


def marked_room(way: TrueState) -> Scene:
    """The room of :func:`rs_localizer.simulation.walls.room` with two markers on each wall.

    Floor and ceiling have none.
    """
    bare = room(way)
    middle = way.positions.mean(axis=0)
    planes, markers = list[TexturedPlane](), list[Marker]()
    for plane in bare.planes:
        if abs(plane.normal[2]) > 0.5:
            planes.append(plane)
            continue
        texture = plane.texture.copy()
        for share in _PLACES:
            markers.append(_hang(texture, plane, share, len(markers), middle))
        planes.append(replace(plane, texture=texture))
    return Scene(tuple(planes), MarkerMap(tuple(markers)))


SCENES = {"three": three_walls, "poster": poster, "room": room, "marked_room": marked_room}
"""All scenes by name, the first one unless another is wanted."""


def _hang(texture: Image, plane: TexturedPlane, share: float, number: int, viewer: Array) -> Marker:
    """Draw a marker into the picture of a plane; the marker."""
    drawn = family(_FAMILY)
    side = drawn.cells * _CELL_TEXELS
    sheet = side + 2 * _CELL_TEXELS
    white = np.pad(pattern(drawn, number), 1, constant_values=True)
    cells = np.where(white, _PAPER, _INK).astype(np.uint8)
    paper = cells.repeat(_CELL_TEXELS, axis=0).repeat(_CELL_TEXELS, axis=1)
    # From inside the room, half of the walls are read from behind.
    mirrored = float(plane.normal @ (viewer - plane.corner)) > 0.0
    height, width = texture.shape
    upright = abs(plane.down[2]) > 0.5
    along, across = (share * width, 0.5 * height) if upright else (0.5 * width, share * height)
    left, top = round(along - 0.5 * sheet), round(across - 0.5 * sheet)
    texture[top : top + sheet, left : left + sheet] = paper[:, ::-1] if mirrored else paper
    centre = plane.points(np.array([[left + 0.5 * sheet, top + 0.5 * sheet]]))[0]
    right, up = (-plane.right if mirrored else plane.right), -plane.down
    pose = Pose(centre, np.column_stack([right, up, np.cross(right, up)]))
    return Marker.at(_FAMILY, number, side * plane.texel, pose)
