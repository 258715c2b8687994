# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The ROS 2 nodes: the only part of the package that imports ROS."""
