# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The pages that users read, taken apart: headings, links, code, tables."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
# Those of docs/cameras are made by docs/make_cameras.py, where the site has been built.
FOLDERS = (".", "docs", "docs/adr", "benchmarks", "examples")
PAGES = sorted(page for folder in FOLDERS for page in (ROOT / folder).glob("*.md"))
NAMES = [str(path.relative_to(ROOT)) for path in PAGES]
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
# In a list an indented line is text; code is indented twice there.
_INDENTED = re.compile(r"(?:^|\n)\n((?:(?: {4}|\t)[^\n]*\n|\n)+)")


class Table(NamedTuple):
    page: str
    columns: list[str]
    rows: list[list[str]]

    def column(self, name: str) -> list[str]:
        return [row[self.columns.index(name)] for row in self.rows]


def text(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def fenced(page: str, language: str) -> list[str]:
    return [code for kind, code in _FENCE.findall(text(page)) if kind == language]


def prose(page: str) -> str:
    without = _FENCE.sub("", text(page))
    return re.sub(r"^ {4}.*$", "", without, flags=re.MULTILINE)


def shell(page: str) -> list[str]:
    """The lines of all blocks of commands; continued ones joined, comments taken off."""
    blocks = [*fenced(page, "bash"), *fenced(page, "")]
    blocks += [re.sub(r"^ {4}", "", code, flags=re.M) for code in _INDENTED.findall(text(page))]
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line for line in (re.sub(r"\s+#.*", "", line).strip() for line in lines) if line]


def anchors(page: str) -> set[str]:
    """What links to a page may name: its headings, as GitHub writes them."""
    headings = re.findall(r"^#+ +(.+)$", _FENCE.sub("", text(page)), re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return {heading.replace(" ", "-") for heading in plain}


def links(page: str) -> list[str]:
    return re.findall(r"\]\(([^)\s]+)\)", prose(page))


def tables(page: str) -> Iterator[Table]:
    lines = prose(page).splitlines()
    for k, line in enumerate(lines):
        if re.fullmatch(r"\|(-+\|)+", line):
            rows = []
            for later in lines[k + 1 :]:
                if not later.startswith("|"):
                    break
                rows.append(_cells(later))
            yield Table(page, _cells(lines[k - 1]), rows)


def all_tables(*columns: str) -> list[Table]:
    found = [table for page in NAMES for table in tables(page)]
    return [table for table in found if set(columns) <= set(table.columns)]


def names_in(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]
