# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map``: describe maps, and make them from recordings and from other maps."""
