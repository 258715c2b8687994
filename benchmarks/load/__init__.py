# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Load on a live node: ``python -m benchmarks.load --help``."""
