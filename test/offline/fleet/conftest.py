"""Makes the module beside it importable, from the tests and from workers."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
