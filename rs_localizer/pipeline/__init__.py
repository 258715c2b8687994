# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The way from a message to what is published, shared by live nodes and offline commands."""
