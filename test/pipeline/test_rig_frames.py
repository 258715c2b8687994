# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Which images become a frame, and which camera is left out: by their times alone."""

import pytest

from rs_localizer.pipeline.rig_frames import CameraImage, FrameAssembler


class Watched:
    """A pair, and what was said of it."""

    def __init__(self, window=0.02):
        self.said = []
        names = ("front", "rear")
        self.pair = FrameAssembler(names, window, lambda _, text: self.said.append(text))

    def add(self, *times):
        """Images as "f33": of the front camera, in the middle of its exposure at 33 ms."""
        frames = []
        for text in times:
            name = {"f": "front", "r": "rear"}[text[0]]
            image = CameraImage(name, 0, round(1e6 * float(text[1:])), None)
            frames += self.pair.add(image)
        return [" ".join(f"{i.camera[0]}{i.middle_ns / 1e6:g}" for i in frame) for frame in frames]


@pytest.mark.parametrize(
    ("window", "order", "frames"),
    [
        *((0.02, order, "f0 r15, f33 r48, f67 r82")
          for order in ("f0 r15 f33 r48 f67 r82", "r15 f0 r48 f33 r82 f67")),
        # Images outside the window are frames of their own.
        (0.01, "f0 r15 f33 r48 f67 r68", "f0, r15, f33, r48, f67 r68"),
        # A recording may start over.
        (0.02, "f5000 r5001 f5033 r5034 f0 r1 f33 r34 f67 r68",
         "f5000 r5001, f5033 r5034, r1, f33 r34, f67 r68"),
    ],
)  # fmt: skip
def test_images_become_frames_whatever_comes_first(window, order, frames):
    watched = Watched(window)
    assert watched.add(*order.split()) == frames.split(", ")
    assert "f5000" in order or watched.said == []


def test_a_camera_that_stops_is_no_longer_awaited_and_named():
    watched = Watched()
    assert watched.add("f0", "r1", "f33", "r34") == ["f0 r1", "f33 r34"]
    # Its image may still come, until it is missing from three frames.
    assert watched.add("f67", "f100", "f133") == ["f67", "f100"]
    assert watched.said == []
    assert watched.add("f167", "f200") == ["f133", "f167", "f200"]
    assert watched.said[0] == "rear is left out: no image in the last 3 frames"
    del watched.said[:]
    # It starts again after the last frame has gone, and is awaited again.
    assert watched.add("r201", "f233", "f267", "r268") == ["r201", "f233", "f267 r268"]
    assert watched.said == []


def test_one_clock_that_jumps_stops_nobody_else():
    watched = Watched()
    assert watched.add("f0", "r1", "f33", "r34") == ["f0 r1", "f33 r34"]
    ahead = watched.add("f67", "r5067", "f100", "r5100", "f133", "r5133", "f167")
    assert [frame for frame in ahead if "f" in frame] == ["f67", "f100", "f133"]
    assert all("r" not in frame for frame in ahead)
    assert "rear is left out: its stamps are 4.967 s ahead of the others" in watched.said
    watched = Watched()
    watched.add("f5000", "r5001", "f5033", "r5034")
    back = watched.add("r0", "f5067", "r33", "f5100", "r67", "f5133", "r100", "f5167", "f5200")
    assert all("r" not in frame for frame in back)
    assert back[-2:] == ["f5167", "f5200"]
    assert watched.said[0] == "rear is left out: its stamps went back by 5.034 s"
