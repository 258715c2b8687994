"""``python -m rs_localizer``."""

import sys

from rs_localizer.cli.main import main

sys.exit(main())
