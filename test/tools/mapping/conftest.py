# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Makes the tests' own scenes importable, and the projector of the tests of the adjustment."""

import sys
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "adjust")]
