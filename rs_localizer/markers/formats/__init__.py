# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Marker maps of other programs: a format per file, read and written."""
