# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The lowest or the newest versions that setup.py allows, as words for pip.

python .ci/versions.py lowest|newest
"""

import os
import re
import runpy
import sys
from typing import Any

import setuptools


def requirements() -> list[str]:
    """What setup.py asks for where there is no ROS."""
    said: dict[str, Any] = {}
    os.environ.pop("AMENT_PREFIX_PATH", None)
    setuptools.setup = lambda **options: said.update(options)
    runpy.run_path("setup.py")
    return list(said["install_requires"])


def main() -> None:
    asked = requirements()
    if sys.argv[1] == "lowest":  # "4.6" is 4.6.0 and what is built of it, as 4.6.0.66
        asked = [re.sub(r">=([\d.]+).*", r"==\1.0.*", line) for line in asked]
    print(*asked)


if __name__ == "__main__":
    main()
