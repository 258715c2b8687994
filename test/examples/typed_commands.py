# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Commands of pages and of heads of examples, typed as they stand there."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

EXAMPLES = Path(__file__).parents[2] / "examples"
RSL = "import sys; from rs_localizer.__main__ import run; sys.exit(run())"


def commands(name: str) -> list[str]:
    """Indented lines of a file of the examples that call one of them, or a command."""
    text = (EXAMPLES / name).read_text()
    return re.findall(r"^ {4}((?:python examples/|rs_localizer ).*?)(?: &&.*)?$", text, re.M)


def started(line: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """A command of a page, typed in a folder with the examples in it."""
    program, *words = shlex.split(line)
    begin = [sys.executable] if program == "python" else [sys.executable, "-c", RSL]
    return subprocess.run(
        [*begin, *words], cwd=folder, env=os.environ | environment, text=True,
        capture_output=True, timeout=600, check=False,
    )  # fmt: skip
