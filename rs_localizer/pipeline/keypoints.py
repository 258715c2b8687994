# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages of images -> keypoints with descriptors: all of the feature detector but ROS.

The node and the offline ``rs_localizer detect --features`` run this one class.
"""

from typing import Any, NamedTuple

from rs_localizer.config import FeatureConfig
from rs_localizer.features.extraction import FeatureExtractor, Features
from rs_localizer.io.clouds import make_cloud, make_rows
from rs_localizer.io.images import Image
from rs_localizer.io.messages import Make


class Extracted(NamedTuple):
    """An image and its keypoints."""

    image: Image
    features: Features


def keypoints(extracted: Extracted, make: Make) -> Any:
    """Make the sensor_msgs/PointCloud2 of an image, for node and bag alike."""
    features = extracted.features
    width = features.descriptors.shape[1]
    numbers = [(name, "<f4") for name in ("u", "v", "score")]
    kinds = [*numbers, ("descriptor", "u1", (width,))]
    rows = make_rows(kinds, [*features.pixels.T, features.scores, features.descriptors])
    return make_cloud(make, extracted.image.stamp_ns, extracted.image.frame, rows)


class FrameExtractor:
    """Finds keypoints in images.

    Args:
        config: its settings.

    Raises:
        ValueError: for features that this OpenCV does not have.
    """

    def __init__(self, config: FeatureConfig) -> None:
        self.described = f"{config.features}, at most {config.max_keypoints} keypoints an image"
        self._extractor = FeatureExtractor(config.features, config.max_keypoints)

    def detect(self, image: Image) -> Extracted:
        """Look for keypoints in an image."""
        return Extracted(image, self._extractor.extract(image.pixels))
