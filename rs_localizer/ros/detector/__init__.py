# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The nodes that look at images: ``marker_detector`` and ``feature_detector``."""
