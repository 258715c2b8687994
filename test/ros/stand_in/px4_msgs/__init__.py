# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What the tests need of px4_msgs, which is not on PyPI: no support for its type in DDS."""
