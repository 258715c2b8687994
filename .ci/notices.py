# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Holds that each source file names its copyright and licence in its first two comment lines.

notices.py         names the files without, exit code 1 if there are any
notices.py --add   gives them the two lines
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

NOTICE = "# Copyright 2026 rs_localizer contributors\n# SPDX-License-Identifier: Apache-2.0\n"
PATTERNS = (
    "*.py", "*.cfg", "*.toml", "*.yml", "config/*.yaml", "rosdoc2.yaml", "test/rosdep_keys.yaml",
    ".ci/run", ".ci/wheels", "Makefile", "packaging/*",
)  # fmt: skip


def main() -> None:
    if not Path(".git").exists():  # an archive: what belongs to it is not known
        return
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", *PATTERNS],
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    without = [path for name in listed.split("\0") if name and lacks(path := Path(name))]
    if "--add" in sys.argv[1:]:
        for path in without:
            path.write_text(noted(path.read_text()))
    elif without:
        print("\n".join(map(str, without)))
        raise SystemExit(f"{len(without)} files without a notice: python .ci/notices.py --add")


def lacks(path: Path) -> bool:
    """Whether a file says something, and not whose it is."""
    return path.is_file() and bool(text := path.read_text()) and NOTICE not in text[:300]


def noted(text: str) -> str:
    """The text with the notice, which a first line for the kernel stays before."""
    interpreter, rest = "", text
    if text.startswith("#!"):
        interpreter, _, rest = text.partition("\n")
        interpreter += "\n"
    # A comment that follows is another paragraph.
    return interpreter + NOTICE + ("#\n" if rest.startswith("#") else "") + rest


if __name__ == "__main__":
    main()
