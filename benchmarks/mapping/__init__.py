# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How good refined maps and surveyed markers are, on rooms whose truth is known."""
