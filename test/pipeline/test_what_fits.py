# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames refused for how their sender counts pixels: what would fit is named.

Pixels are the independent projector's, each at the time of its row.
"""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.independent.cameras import Camera as TrueCamera
from rs_localizer.config import DetectorConfig, NodeConfig
from rs_localizer.core.reasons import Reason
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.images import Image
from rs_localizer.localizer import Localizer
from rs_localizer.markers.dictionaries import pattern
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.pipeline.marker_detector import FrameDetector
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.pipeline.what_fits import Mistakes, what_fits

from ..moving import camera_of, shown  # noqa: TID252 - Python has a package "test"
from .clouds import cloud_of

TRUE = TrueCamera(focal=500.0, distortion=(0.0,) * 5)
K, READOUT, CAMERA = TRUE.matrix, TRUE.readout_time, camera_of(TRUE)
RATE, VELOCITY = np.array([0.4, -0.6, 0.5]), np.array([0.3, 0.1, -0.2])


def corners():
    """Corners (40,3) of ten markers of 0.24 m on two walls, in the order of ArUco."""
    square = 0.12 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    found = []
    for k in range(5):
        middle = np.array([-0.7 + 0.35 * k, -0.4 + 0.3 * (k % 3)])
        flat = middle + square
        found.append(np.column_stack([flat[:, 0] - 0.5, flat[:, 1], np.full(4, 3.6)]))
        found.append(np.column_stack([np.full(4, 0.5), flat[:, 1], 2.8 - flat[:, 0]]))
    return np.concatenate(found)


def seen(points, t, noise=0.3):
    """Pixels (n,2) of points at the stamp t of the middle row."""

    def pose(after):
        time = (t + after)[:, None]
        return Rotation.from_rotvec(time * RATE), time * VELOCITY

    pixels = shown(TRUE, pose, points)
    return pixels + noise * np.random.default_rng(round(1e3 * t)).normal(size=pixels.shape)


MISTAKES = {
    "mirrored, left to right or top to bottom": lambda pixels: pixels * [-1.0, 1.0] + [639.0, 0.0],
    "mirrored, left to right or top": lambda pixels: pixels * [1.0, -1.0] + [0.0, 479.0],
    "exchanged": lambda pixels: pixels[:, ::-1],
}


MIRROR = MISTAKES["mirrored, left to right or top to bottom"]


@pytest.mark.parametrize("name", MISTAKES)
def test_each_mistake_is_named_and_no_other(name):
    points = corners()
    pixels = MISTAKES[name](seen(points, 0.2))
    for camera in (CAMERA, camera_of(TRUE, readout_time=0.0)):
        localizer = Localizer(camera)
        assert not localizer.localize(points, pixels)
        said = what_fits(localizer, points, pixels)
        assert name in said
        assert not any(other in said for other in MISTAKES if not other.startswith(name[:8]))


def test_what_is_right_or_otherwise_wrong_has_no_name():
    points, localizer, rng = corners(), Localizer(CAMERA), np.random.default_rng(0)
    pixels = seen(points, 0.1)
    assert localizer.localize(points, pixels)
    for wrong in (
        rng.uniform([0, 0], [639, 479], (40, 2)),  # chance
        rng.permutation(pixels),  # other landmarks
    ):
        assert not localizer.localize(points, wrong)
        assert what_fits(localizer, points, wrong) == ""
    another_lens = 0.6 * (pixels - K[:2, 2]) + K[:2, 2] + rng.normal(0.0, 12.0, (40, 2))
    assert what_fits(localizer, points, another_lens) == ""
    # A plane that is mirrored is one that is seen from behind.
    wall_alone = points[:, 2] == 3.6
    flat, mirrored = points[wall_alone], MIRROR(pixels[wall_alone])
    assert localizer.localize(flat, mirrored)
    assert (
        what_fits(localizer, flat, mirrored) == what_fits(localizer, flat, pixels[wall_alone]) == ""
    )
    assert [what_fits(localizer, points[:n], pixels[:n]) for n in range(5)] == [""] * 5


def test_a_day_of_refusals_costs_ten_tries():
    tries = []
    mistakes = Mistakes()
    for _ in range(30 * 86_400):
        assert mistakes.explain_frame(lambda: tries.append(1) or "") == ""
    assert len(tries) == 11
    # Two frames have to agree, then nothing is tried any more.
    said, answers = Mistakes(), iter(["a", "b", "b"])
    assert [said.explain_frame(lambda: next(answers)) for _ in range(5)] == ["", "", "b", "b", "b"]


def cloud(t, pixels):
    return cloud_of(round((5.0 + t) * 1e9), corners(), pixels)


@pytest.fixture
def begun(make_camera_info):
    """Frames of the camera, and what they tell."""
    told = []
    frames = CameraFrames(NodeConfig(readout_time=READOUT), lambda *notice: told.append(notice))
    info = {"k": K.ravel(), "width": 640, "height": 480, "d": []}
    frames.calibrate(read_camera_info(make_camera_info(**info)))
    return frames, told


def test_frames_say_it(begun):
    frames, told = begun
    times = np.arange(4) / 30.0
    results = [frames.localize(cloud(t, MIRROR(seen(corners(), t)))) for t in times]
    assert all(isinstance(result, Refusal) for result in results)
    assert ["mirrored, left to right" in result.detail for result in results[1:]] == [True] * 3
    assert {name for name, _ in told} >= {"would_fit"}
    assert frames.localize(cloud(1.0, seen(corners(), 0.2)))


def test_a_mirrored_room_of_which_one_wall_fits(begun):
    """Seen from behind, 24 of the 56 points have a pose; all of them have one unmirrored."""
    rng = np.random.default_rng(1)
    flat = rng.uniform([-1.2, -0.9, 3.6], [1.2, 0.9, 3.6], (24, 3))
    depth = rng.uniform([-1.2, -0.9, 2.0], [1.2, 0.9, 5.0], (32, 3))
    (frames, told), room = begun, np.concatenate([flat, depth])

    def localized(k, undo):
        time = k / 30.0
        stamp = round((5.0 + time) * 1e9)
        return frames.localize(cloud_of(stamp, room, undo(seen(room, time))))

    first, *others = [localized(k, MIRROR) for k in range(4)]
    assert first  # of the wall
    assert all(not other and other.reason == Reason.CALIBRATION for other in others)
    assert "mirrored" in dict(told)["would_fit"]
    # Once pixels are right, poses come again.
    assert all(localized(k, np.array) for k in range(4, 8))


def test_mirrored_images_of_markers():
    """Most markers are none, mirrored, some are others: their pixels tell nothing."""
    marker_map = MarkerMap(wall("4x4_50", (4, 2), 0.12, 0.06), map_frame="hall")
    image = np.full((300, 560), 220, np.uint8)
    for k, marker in enumerate(marker_map.markers):
        cells = np.kron(pattern(marker.family, marker.id), np.ones((14, 14)))
        drawn = cv2.resize(np.where(cells > 0, 220, 20).astype(np.uint8), (80, 80))
        row, column = divmod(k, 4)
        image[40 + 120 * row : 120 + 120 * row, 40 + 120 * column : 120 + 120 * column] = drawn
    told = []
    detector = FrameDetector(DetectorConfig(), lambda *notice: told.append(notice), marker_map)
    assert len(detector.detect(Image(1, "camera", image)).detections.ids) == 32
    assert (detector.mistake, told) == ("", [])
    for flipped in (image[:, ::-1], image[::-1]):
        detector = FrameDetector(DetectorConfig(), lambda *notice: told.append(notice), marker_map)
        for k in range(3):
            detector.detect(Image(k, "camera", np.ascontiguousarray(flipped)))
        assert "the images are mirrored" in detector.mistake
    assert "would_fit" in dict(told)
    detector = FrameDetector(DetectorConfig(), marker_map=marker_map)
    for k in range(3):
        detector.detect(Image(k, "camera", np.full((300, 560), 220, np.uint8)))
    assert detector.mistake == ""
