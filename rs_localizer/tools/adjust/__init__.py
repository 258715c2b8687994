# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Continuous-time least squares: variables, factors that are rows, one sparse solution.

A motion is a spline (:mod:`.spline`), everything else a block of unknowns (:mod:`.variables`),
everything measured or known a factor that gives whitened rows (:mod:`.reprojection`, :mod:`.gyro`,
:mod:`.motion`, :mod:`.priors`). :mod:`.system` solves what they add up to, :mod:`.problem` names
the unknowns of cameras on one motion, and :mod:`.fit` finds their most likely values.
"""
