# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What replay found, for the Rerun viewer: nothing here changes a pose."""
