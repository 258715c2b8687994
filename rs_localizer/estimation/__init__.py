# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The way from the points of one image to the posterior of its motion."""
