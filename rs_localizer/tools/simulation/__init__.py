# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated frames, rendered images, an IMU, their truth and their recordings."""
