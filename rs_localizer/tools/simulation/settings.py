# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What simulations can be asked for. Imports nothing that takes time: commands show it as help."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from rs_localizer.io.video import Image

# As the format of sensor_msgs/CompressedImage says it.
FORMATS = ("jpeg", "png")
_QUALITY = 95  # of JPEG: its artefacts stay below the noise of a corner

# Camera axes (x right, y down, z forward) in the body axes of a recorded trajectory; columns are
# the camera's axes. Motion capture of a rig or robot mostly gives REP-103's body, x forward and
# z up; of a camera data set, the camera itself.
BODY_FROM_CAMERA = {
    "forward_left_up": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
    "optical": np.eye(3),
}

# Motion capture at 100 Hz and more shakes by a few tenths of a degree from sample to sample: a
# spline through every sample turns that into accelerations that no hand has (0.24 degrees median,
# 8 at worst, off constant velocity within 30 ms on TUM VI room5; 0.04 and 0.27 with knots of
# 50 ms, which stay within 0.15 mm and 0.07 degrees, median, of the samples). A hand moves below
# 10 Hz, and knots of 50 ms follow that.
KNOT_SPACING = 0.05


@dataclass(frozen=True, slots=True)
class FrameSettings:
    """What is seen in each frame, and how badly."""

    points: int = 150  # at most; fewer where the map shows fewer
    noise: float = 1.0  # standard deviation of u and of v, raw pixels
    outliers: float = 0.3  # share of the points whose pixel is uniform in the image
    rate: float = 30.0  # frames per second


@dataclass(frozen=True, slots=True)
class ImageSettings:
    """What the sensor does to the picture."""

    exposure: float = 0.0  # s that each row is exposed, around its row time; 0: an instant
    noise: float = 0.0  # standard deviation of a grey level (of 255)


@dataclass(frozen=True, slots=True)
class ImuSettings:
    """How good an IMU is: that of a phone or a drone."""

    rate: float = 400.0  # Hz
    gyroscope_noise: float = math.radians(0.01)  # rad/s/sqrt(Hz)
    gyroscope_bias: float = math.radians(0.5)  # rad/s, in any direction
    gyroscope_bias_walk: float = math.radians(0.002)  # rad/s^2/sqrt(Hz)
    accelerometer_noise: float = 2e-3  # m/s^2/sqrt(Hz)
    accelerometer_bias: float = 0.05  # m/s^2, in any direction
    time_offset: float = 0.0  # s to be added to its stamps to get the camera's time


@dataclass(frozen=True, slots=True)
class Encoding:
    """How images are compressed."""

    format: str = "jpeg"

    def __call__(self, image: Image) -> bytes:
        parameters = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY] if self.format == "jpeg" else []
        done, data = cv2.imencode(f".{self.format}", image, parameters)
        if not done:
            raise ValueError(f"an image of {image.shape} cannot be written as {self.format}")
        return bytes(data.tobytes())
