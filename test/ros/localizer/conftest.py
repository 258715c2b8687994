# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Makes what sends and hears importable from the tests beside it and below, and what records."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.append(str(Path(__file__).parents[2] / "pipeline"))
