# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""From a message to what is published of it: what the live nodes and the offline commands share."""
