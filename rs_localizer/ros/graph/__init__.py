# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Other nodes of the graph: a player of recordings, listeners."""
