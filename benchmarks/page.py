# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``COMMAND | python -m benchmarks.page NAME`` keeps what a bench prints, for docs/benchmarks.md.

The text goes to ``results/NAME.txt`` with commit and date. The page is written by hand; its blocks
after ``<!-- NAME -->`` are filled with these files, and it links to those without a block. Without
a name all blocks are filled anew.
"""

import re
import subprocess
import sys
from datetime import date
from pathlib import Path

from benchmarks import command

ROOT = Path(__file__).parents[1]
PAGE, RESULTS = ROOT / "docs" / "benchmarks.md", ROOT / "benchmarks" / "results"
_BLOCK = re.compile(r"^(<!-- ([\w-]+) -->\n```text\n).*?^```$", re.MULTILINE | re.DOTALL)


def blocks(page: str) -> dict[str, str]:
    """Figures of a page by the names of their blocks."""
    return {
        found[2]: found[0].removeprefix(found[1]).removesuffix("```")
        for found in _BLOCK.finditer(page)
    }


def filled(page: str, results: Path = RESULTS) -> str:
    """The page with each block as its bench printed it; one whose bench never ran is empty."""

    def fill(found: re.Match[str]) -> str:
        printed = results / f"{found[2]}.txt"
        return f"{found[1]}{printed.read_text(encoding='utf-8') if printed.exists() else ''}```"

    return _BLOCK.sub(fill, page)


def record(name: str, printed: str) -> None:
    """Keep what a bench has printed, with the commit that is checked out and the date."""
    git = ["git", "-C", str(ROOT)]
    commit = subprocess.check_output([*git, "rev-parse", "--short=8", "HEAD"], text=True).strip()
    changed = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", "*.py"], check=False)
    commit += " and changes" if changed.returncode else ""
    lines = [line.rstrip() for line in printed.strip("\n").splitlines()]
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{name}.txt").write_text(
        "\n".join([*lines, f"(commit {commit}, {date.today():%d %B %Y})", ""]), encoding="utf-8"
    )


def main() -> int:
    """Record one block, or fill all of them; the exit code."""
    parser = command(".page", __doc__)
    page = PAGE.read_text(encoding="utf-8")
    known = sorted({*blocks(page), *(file.stem for file in RESULTS.glob("*.txt"))})
    parser.add_argument("name", nargs="?", choices=known, help="of the file")
    name = parser.parse_args().name
    if name is not None:
        printed = sys.stdin.read()
        if not printed.strip():
            parser.error(f"nothing was printed: {name} stays as it is")
        record(name, printed)
    PAGE.write_text(filled(page), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
