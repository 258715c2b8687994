# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Continuous-time least squares: variables, factors that are rows, one sparse solution.

A motion is a spline (:mod:`.spline`); all other unknowns are blocks (:mod:`.variables`). Each
measurement or prior is a factor that gives whitened rows (:mod:`.reprojection`,
:mod:`.factors`). The module :mod:`.system` solves their sum. The module
:mod:`.problem` names the unknowns of cameras on one motion, and :mod:`.fit` finds their most likely
values.
"""
