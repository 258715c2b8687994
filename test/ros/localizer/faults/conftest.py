"""Makes the parts of the fault matrix importable."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
