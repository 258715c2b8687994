# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Wrong input for everything that reads messages, files and settings.

``python -m benchmarks.fuzzing --executions 1000000`` runs for long, the
tests for a moment.
"""
