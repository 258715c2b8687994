# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What every program begins with: signals, threads, arguments, and what is not installed."""
