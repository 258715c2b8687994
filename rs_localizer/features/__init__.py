# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Features of images: keypoints with descriptors, by OpenCV."""
