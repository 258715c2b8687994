# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Honesty: are the covariances what they say, on motion and calibrations as they really are?

All frames are of the independent simulator (:mod:`benchmarks.independent`), and the estimator is
used through its public interfaces only.
"""
