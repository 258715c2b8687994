# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Gyroscope and accelerometer: what turns and shakes the camera while its rows are exposed."""
