"""The map that keypoints are matched with: read from its file, and what is odd about it."""

from __future__ import annotations

from pathlib import Path

from rs_localizer.core.reasons import Notice
from rs_localizer.io.maps.files import read_map_file
from rs_localizer.io.maps.landmarks import Map, MapError


def read_landmarks(file: str, frame: str) -> Map:
    """The map of a file, to match keypoints with.

    Args:
        file: its path; ``~`` is the user's home.
        frame: of its points.

    Raises:
        MapError: for a file that cannot be read or holds no such map.
    """
    path = Path(file).expanduser()
    try:
        landmarks = read_map_file(path, frame)
    except MapError as error:
        raise MapError(f"map_file: {error}") from error
    except OSError as error:
        raise MapError(f"map_file: {path} cannot be read: {error.strerror or error}") from error
    if landmarks.ids is None and landmarks.descriptors is None:
        raise MapError(
            f"map_file: {path}: keypoints cannot be matched with a map that has neither ids "
            "nor descriptors"
        )
    return landmarks


def oddities_of_map(landmarks: Map, previous: Map | None) -> dict[Notice, str]:
    """What is worth telling of a map that takes the place of another, or of none."""
    found: dict[Notice, str] = {}
    if landmarks.dropped:
        found[Notice.MAP_INCOMPLETE] = (
            f"{landmarks.dropped} landmarks are left out: they hold NaN or infinity, or no "
            "descriptor"
        )
    if previous is not None:
        found[Notice.MAP_REPLACED] = (
            f"a map of {len(landmarks)} landmarks in frame {landmarks.frame!r} replaces the "
            f"one of {len(previous)} in frame {previous.frame!r}"
        )
    return found
