# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Tools that make a camera or a map known from recordings; only the commands import them."""
