# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The dictionaries of markers that OpenCV knows, by the names that users write."""

import difflib
import re
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class Family:
    """A dictionary of square black-and-white markers."""

    name: str
    kind: str  # families of one kind share their patterns: 4x4_50 is the start of 4x4_100
    bits: int  # cells along a side inside the black border
    count: int  # ids are 0 to count - 1
    first: int  # pattern of id 0, upright: row by row from the top left, 1 is white
    border: int = 1  # cells

    @property
    def cells(self) -> int:
        """Cells along a side, with the border, as a marker's size counts."""
        return self.bits + 2 * self.border

    @property
    def constant(self) -> str:
        """Name of the dictionary in ``cv2.aruco``."""
        return f"DICT_{self.name.removesuffix(_WIDE).upper()}"


_WIDE = "_border2"


def _table() -> dict[str, Family]:
    nested = ((4, 0xB532), (5, 0x145B2BC), (6, 0x1E3DD82A6), (7, 0x1BAB8D94B9415))
    rows = [
        Family(f"{bits}x{bits}_{count}", f"{bits}x{bits}", bits, count, first)
        for bits, first in nested
        for count in (50, 100, 250, 1000)
    ]
    for name, bits, count, first in (
        ("aruco_original", 5, 1024, 0x1084210),
        ("aruco_mip_36h12", 6, 250, 0xD2B63A09D),  # OpenCV 4.8 and later
        # Upright as AprilRobotics prints them: these are the codes of their library.
        ("apriltag_16h5", 4, 30, 0x231B),
        ("apriltag_25h9", 5, 35, 0x155CBF1),
        ("apriltag_36h10", 6, 2320, 0x1CA92A687),
        ("apriltag_36h11", 6, 587, 0xD5D628584),
    ):
        rows.append(Family(name, name, bits, count, first))
    wide = rows[-1].name + _WIDE  # of Kalibr's AprilGrid
    rows.append(replace(rows[-1], name=wide, kind=wide, border=2))
    return {family.name: family for family in rows}


FAMILIES = _table()
# Markers that nobody has listed, where they are smaller (px), may be anything, and their corners
# say little.
LEAST_SIDE = 12.0


def family(name: object) -> Family:
    """Return the family with a name: ``4x4_50``, ``apriltag_36h11``, ``aruco_original`` ...

    OpenCV's spelling (``DICT_4X4_50``) and that of AprilTag's own library (``tag36h11``) do, too.

    Raises:
        ValueError: for a name that is none.
    """
    text = str(name).lower().removeprefix("dict_")
    text = re.sub(r"^(tag)?(?=\d\dh\d)", "apriltag_", text)
    text = re.sub(r"^aruco_(?=\dx\d)", "", text)
    if text in FAMILIES:
        return FAMILIES[text]
    close = difflib.get_close_matches(text, FAMILIES, n=1)
    hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(FAMILIES)}"
    raise ValueError(f"unknown family {name!r}; {hint}")
