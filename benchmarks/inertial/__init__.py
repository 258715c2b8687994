# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What a gyroscope beside the camera is worth: vibration, few points, stamps, cost."""
