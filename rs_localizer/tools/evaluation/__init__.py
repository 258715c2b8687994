# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How far estimates are from the truth, in numbers and pictures."""
