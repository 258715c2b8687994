# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Examples are scripts: they find each other beside themselves."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
