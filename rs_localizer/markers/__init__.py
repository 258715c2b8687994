# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Markers and boards: their map, finding them in images, printing and drawing them.

Names are imported from the modules themselves.
"""
