# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The path from a message to its outputs, shared by live nodes and offline commands."""
