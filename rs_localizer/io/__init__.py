# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs: messages, recordings, trajectories; no ROS needed."""
