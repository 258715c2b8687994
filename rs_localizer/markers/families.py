"""The dictionaries of markers that OpenCV knows, by the names that users write."""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Family:
    """A dictionary of square black-and-white markers."""

    name: str
    kind: str  # families of one kind share their patterns: 4x4_50 is the start of 4x4_100
    bits: int  # cells along a side inside the black border of one cell
    count: int  # ids are 0 to count - 1

    @property
    def cells(self) -> int:
        """Cells along a side, with the border: what a marker's size spans."""
        return self.bits + 2

    @property
    def constant(self) -> str:
        """Name of the dictionary in ``cv2.aruco``."""
        return f"DICT_{self.name.upper()}"


def _table() -> dict[str, Family]:
    sizes = dict.fromkeys((4, 5, 6, 7), (50, 100, 250, 1000))
    rows = [
        Family(f"{bits}x{bits}_{count}", f"{bits}x{bits}", bits, count)
        for bits, counts in sizes.items()
        for count in counts
    ]
    for name, bits, count in (
        ("aruco_original", 5, 1024),
        ("aruco_mip_36h12", 6, 250),  # OpenCV 4.8 and later
        ("apriltag_16h5", 4, 30),
        ("apriltag_25h9", 5, 35),
        ("apriltag_36h10", 6, 2320),
        ("apriltag_36h11", 6, 587),
    ):
        rows.append(Family(name, name, bits, count))
    return {family.name: family for family in rows}


FAMILIES = _table()


def family(name: object) -> Family:
    """The family of a name: ``4x4_50``, ``apriltag_36h11``, ``aruco_original`` and so on.

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
