"""From keypoints and a first guess to the keypoints that count and a first motion."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.camera import Camera
from rs_localizer.mapping.first_motion import first_motion
from rs_localizer.mapping.sightings import (
    LEAST_KEYPOINTS,
    MapFreedom,
    Sightings,
    Start,
    shared_landmarks,
)
from rs_localizer.trajectory.model import Observations
from rs_localizer.trajectory.spline import LONGEST_GAP, Spline
from rs_localizer.trajectory.spline_kernels import CONTROL

# Beyond so many unknowns of the motion its matrix takes more than 2 GB.
_MOST_UNKNOWNS = 15000
# Landmarks are held to where they were by the map's size, which says nothing, but for those that
# hardly any image sees.
_LOOSE = 1.0
# So many landmarks of known place hold the map's frame and size.
_LEAST_ANCHORS = 3
# Images in a row that may tell the readout time.
_LEAST_STRETCH = 20


class Preparation:
    """The keypoints that count, and the first motion."""

    def __init__(
        self, camera: Camera, seen: Sightings, start: Start, freedom: MapFreedom,
        stamp_offset: float,
    ) -> None:  # fmt: skip
        self.camera, self.seen, self.start, self.freedom = camera, seen, start, freedom
        self.start_ns = int(seen.stamps_ns[0])
        delay = stamp_offset - camera.readout_time * camera.first_row_time
        self.times = np.asarray(1e-9 * (seen.stamps_ns - self.start_ns) + delay, np.float64)
        self.size = float(np.linalg.norm(np.ptp(start.points, axis=0)))
        self.deviations, self.floating = self._known()
        self.used = self._usable()
        self.spline = self._spline()
        if freedom.readout_time:
            self._check_stretches()
        held = CONTROL * len(self.spline.positions)
        if held > _MOST_UNKNOWNS:
            raise ValueError(
                f"{len(self.times)} images have {held} unknowns of motion, at most "
                f"{_MOST_UNKNOWNS} can be refined at once: leave images out"
            )

    def _known(self) -> tuple[Array, bool]:
        """Deviations (p,) of the landmarks, m, and whether nothing holds the whole."""
        given = self.freedom.deviations
        if given is None:
            given = np.full(len(self.start.points), np.inf)
        anchors = np.count_nonzero(np.isfinite(given))
        if 0 < anchors < _LEAST_ANCHORS:
            raise ValueError(
                f"{anchors} landmarks of known place do not hold a map: none, or at least "
                f"{_LEAST_ANCHORS}, can be given"
            )
        return np.minimum(given, _LOOSE * self.size), anchors == 0

    def _usable(self) -> BoolArray:
        """Keypoints (n,) that say something of map or motion."""
        shared = np.zeros(len(self.start.points), np.bool_)
        found = shared_landmarks(self.seen)
        shared[: len(found)] = found
        if self.freedom.deviations is not None:
            shared |= np.isfinite(self.freedom.deviations)
        used = shared[self.seen.landmarks]
        counts = np.bincount(self.seen.images[used], minlength=len(self.times))
        return used & (counts >= LEAST_KEYPOINTS)[self.seen.images]

    def _spline(self) -> Spline:
        """Through the images with keypoints: stretches where they follow each other."""
        own = np.unique(self.seen.images[self.used])
        return first_motion(
            self.times[own], self.start.rotations[own], self.start.positions[own],
            self.camera.readout_time,
        )  # fmt: skip

    def _check_stretches(self) -> None:
        """Raise ValueError when the readout time cannot be found."""
        if not self.tells_readout:
            raise ValueError(
                f"the readout time is found from at least {_LEAST_STRETCH} images that follow each "
                f"other within {LONGEST_GAP} s, found {self._longest()}: give it, or more "
                "of the recording"
            )

    @property
    def tells_readout(self) -> bool:
        """Images on their own tell turn and way per readout only, and not how long it takes."""
        return self._longest() >= _LEAST_STRETCH

    def _longest(self) -> int:
        """Images in the longest stretch."""
        own = self.times[np.unique(self.seen.images[self.used])]
        return int(np.bincount(self.spline.layout.stretches(own)).max())

    def observations(self) -> Observations:
        images, pixels = self.seen.images[self.used], self.seen.pixels[self.used]
        return Observations(
            times=self.times[images],
            row_times=self.camera.row_time(pixels),
            pixels=pixels,
            landmarks=self.start.points,
            points=self.seen.landmarks[self.used],
            frames=images,
            trusted=np.ones(len(images), np.bool_),
        )
