# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Real videos of boards, judged without a truth: repeatability, held-out corners, neighbours."""
