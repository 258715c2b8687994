# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Parts that every node of this package needs."""
