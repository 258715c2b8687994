# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Maps from images: landmarks and markers refined together with the motion that saw them."""
