# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Many frames at once: continuous-time motion, its estimator, calibration and smoothing."""
