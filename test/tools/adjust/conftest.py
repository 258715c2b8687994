# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Makes the tests' own projector importable."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
