# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What goes in and out: messages, recordings, trajectories; no ROS needed."""
