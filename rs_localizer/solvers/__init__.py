# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Minimal solvers for the absolute pose of a rolling-shutter camera."""
