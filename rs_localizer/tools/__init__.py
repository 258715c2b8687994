# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What makes a camera or a map known from recordings; nothing but the commands imports it."""
