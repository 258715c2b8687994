# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The node ``feature_detector``: images in; keypoints with descriptors out."""

from rs_localizer.config import FeatureConfig
from rs_localizer.features.extraction import draw_features
from rs_localizer.io.topics import KEYPOINTS
from rs_localizer.pipeline.keypoints import Extracted, FrameExtractor, keypoints
from rs_localizer.ros.detector.image_node import ImageNode, Picture
from rs_localizer.ros.node.diagnostics import State
from rs_localizer.ros.node.statistics import Told
from rs_localizer.settings import FEATURES_NAME


def tell(extracted: Extracted) -> tuple[int, Told]:
    """Return the stamp of an image (ns), and what the statistics keep of it."""
    count = len(extracted.features)
    text = f"{count or 'no'} keypoints in the last image"
    return extracted.image.stamp_ns, Told(State.DETECTING, text, {"Keypoints": str(count)})


def draw(extracted: Extracted) -> Picture:
    """Return the image with its keypoints."""
    return draw_features(extracted.image.pixels, extracted.features)


class FeatureDetectorNode(ImageNode[FeatureConfig, Extracted]):
    """Looks for keypoints."""

    node_name = task = FEATURES_NAME
    kind, output, finder = FeatureConfig, KEYPOINTS, FrameExtractor
    tell, make_cloud, draw = staticmethod(tell), staticmethod(keypoints), staticmethod(draw)
