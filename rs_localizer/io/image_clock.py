# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Times at which the images of a file were taken, as far as they are known, else assumed."""

from dataclasses import dataclass

DEFAULT_START_NS = 1_000_000_000
"""Stamp of the zero of a video's clock, which all its streams have: to ROS, 0 means none."""

# Rates that differ by less are called the same by cameras and by those who give --rate: 29.97, 30.
_SAME_RATE = 0.02
# In the dark, phones expose longer and take somewhat fewer images than they note; slow motion is at
# least half as slow.
_OTHER_RATE = 1.5


@dataclass(slots=True)
class ImageClock:
    """Stamps of the images of a video or a folder, one after the other.

    Args:
        rate: images per second instead of the file's own times; None: these.
        missing: sentence on images that could not be read.
        captured: images per second that the camera took, by a note of the file; None: unknown.
        absolute: the images' own times are names of files, and not a video's since its start.
    """

    rate: float | None = None
    missing: str | None = None
    captured: float | None = None
    absolute: bool = False
    _images: int = 0
    _first_ns: int = 0  # own time of the first image
    _last_ns: int = 0  # own time of the last image that has one
    _timed: int = 0  # images with a time of their own, before any rate

    @property
    def _zero_ns(self) -> int:
        """Stamp of the zero of the file's clock; a rate counts from it, or from the first image."""
        return 0 if self.absolute else DEFAULT_START_NS

    @property
    def _start_ns(self) -> int:
        return self._first_ns if self.absolute else DEFAULT_START_NS

    def stamp(self, own_ns: int | None) -> int | None:
        """Return the stamp of the next image by its own time; None if unknown.

        Raises:
            ValueError: when the file has no times and no rate was given.
        """
        index, self._images = self._images, self._images + 1
        if own_ns is not None:
            self._first_ns = self._first_ns if self._timed else own_ns
            self._last_ns, self._timed = own_ns, self._timed + 1
        if self.rate is not None:
            return self._start_ns + round(index * 1e9 / self.rate)
        if own_ns is None and index <= 1:  # the first is at 0 in a file without times, too
            raise ValueError("the images have no times of their own: give --rate")
        return None if own_ns is None else self._zero_ns + own_ns

    @property
    def own_rate(self) -> float | None:
        """Mean images per second by the file's own times; None: it has none."""
        span = self._last_ns - self._first_ns
        return (self._timed - 1) * 1e9 / span if span > 0 else None

    def description(self) -> str:
        """Describe the origin of the stamps in one sentence."""
        own = "the names of the files" if self.absolute else "the presentation times of the video"
        source = own if self.rate is None else f"--rate {self.rate:g}"
        own_rate = self.own_rate
        pace = f", {own_rate:.4g} images/s on average" if own_rate and self.rate is None else ""
        first_ns = self._zero_ns + self._first_ns if self.rate is None else self._start_ns
        return f"times: {source}{pace}; the first image at {round(first_ns * 1e-9, 3):.14g} s"

    def fault(self) -> str | None:
        """Describe the fault of the images' times, or of a given rate."""
        own_rate = self.own_rate
        if self.missing is not None or self.rate is None or own_rate is None:
            return self.missing
        known = own_rate if self.captured is None else self.captured
        if any(abs(self.rate / rate - 1.0) <= _SAME_RATE for rate in (own_rate, known)):
            return None
        return (
            f"--rate {self.rate:g} disagrees with the file, whose own times mean "
            f"{own_rate:.4g} images/s; velocities are wrong by that factor: leave --rate out "
            "unless the file was slowed down or sped up"
        )

    def slow_motion(self) -> str | None:
        """Describe a video that plays at another rate than it was taken at; None if it does not."""
        pace = self.rate or self.own_rate
        if self.captured is None or pace is None:
            return None
        factor = self.captured / pace
        if 1.0 / _OTHER_RATE < factor < _OTHER_RATE:
            return None
        off = f"{max(factor, 1.0 / factor):.3g} times too {'small' if factor > 1.0 else 'large'}"
        return (
            f"the camera took {self.captured:.4g} images/s, as the file notes, and its times mean "
            f"{pace:.4g}: in slow motion or time lapse velocities are {off}; --rate "
            f"{self.captured:g} gives true times"
        )


def readout_fault(readout_time: float, period: float) -> str | None:
    """Describe the fault of a readout that is longer than the interval of images.

    Args:
        readout_time: s.
        period: s between images; NaN where unknown.
    """
    if not readout_time > period:  # NaN compares false
        return None
    return (
        f"the readout time of {1e3 * readout_time:.4g} ms is longer than the "
        f"{1e3 * period:.4g} ms from image to image: is it in seconds, and are the stamps right?"
    )
