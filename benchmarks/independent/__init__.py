# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A second simulator, to judge the estimator by: it shares no line with what it judges.

Rotations, lens, shutter and motions are written anew in NumPy, and nothing else of the package is
imported (a test holds this), so that a mistake in the estimator's own geometry, or in the first
simulator that was made together with it, cannot hide. Conventions are those of
docs/architecture.md: the map in metres, the camera's optical frame (x right, y down, z forward),
twists of the camera with respect to the map in the camera's axes, raw pixels with the first
pixel's centre at 0, 0.
"""
