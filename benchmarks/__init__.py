# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Experiments, a second simulator to judge by, fuzzing and load; not installed."""
