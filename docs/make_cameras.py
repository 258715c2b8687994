# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Writes a page of each camera whose readout time is known, and all of them as JSON.

    python docs/make_cameras.py [FOLDER]

The site has them (``make docs``); the table is ``rs_localizer/data/readout_times/table.csv``.
"""

from __future__ import annotations

import json
import re
import sys
from itertools import groupby
from pathlib import Path

from rs_localizer.readout import Known, as_json, known_cameras

FOLDER = Path(__file__).with_name("cameras")
JSON = "readout_times.json"
_INDEX = """\
# Readout times of {count} cameras

What others say, of modes that may not be yours: `rs_localizer calibrate` measures yours in ten
seconds ([calibration.md](../calibration.md)), and `rs_localizer readout NAME` prints this table. As
JSON: [{json}]({json}), in seconds from the first to the last row.

| camera | modes | ms |
|---|---|---|
{rows}

```{{toctree}}
:hidden:

{names}
```
"""
_PAGE = """\
# {name}: rolling-shutter readout time

| mode | readout time, median (ms) | quartiles (ms) | said by | source |
|---|---|---|---|---|
{rows}

From the first row to the last.{note} Modes, firmware and stabilization change it: measure yours
with a chessboard or any printed markers,

    rs_localizer calibrate video.mp4 --board 9x6 --square 0.025 --out shutter.yaml

and give it to the localizer: `--params shutter.yaml`, or `-p readout_time:={median}`
([camera.md](../camera.md)). [More]({sources}).
"""
_BOUND = (
    " A value near the whole interval between images (marked *) is rather an upper bound than a"
    " measurement."
)


def write(folder: Path = FOLDER) -> None:
    """Write the pages, an index and :data:`JSON`."""
    folder.mkdir(parents=True, exist_ok=True)
    table = sorted(known_cameras(), key=lambda entry: (entry.name.lower(), entry.mode))
    cameras = {
        slug: list(entries) for slug, entries in groupby(table, lambda entry: _slug(entry.name))
    }
    (folder / JSON).write_text(json.dumps([as_json(entry) for entry in table], indent=1) + "\n")
    for slug, entries in cameras.items():
        (folder / f"{slug}.md").write_text(_page(entries), encoding="utf-8")
    rows = [
        f"| [{entries[0].name}]({slug}.md) | {len(entries)} | {_range(entries)} |"
        for slug, entries in cameras.items()
    ]
    text = _INDEX.format(
        count=len(cameras), json=JSON, rows="\n".join(rows), names="\n".join(cameras)
    )
    (folder / "index.md").write_text(text, encoding="utf-8")


def _slug(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def _range(entries: list[Known]) -> str:
    low, high = (1e3 * pick(entry.median for entry in entries) for pick in (min, max))
    return f"{low:.4g}" if high - low < 0.005 else f"{low:.4g} to {high:.4g}"


def _page(entries: list[Known]) -> str:
    rows = [
        f"| {entry.mode} | {1e3 * entry.median:.2f}{'*' if entry.upper_bound else ''} "
        f"| {1e3 * entry.low:.2f} to {1e3 * entry.high:.2f} | {entry.number} | {entry.source} |"
        for entry in entries
    ]
    return _PAGE.format(
        name=entries[0].name,
        rows="\n".join(rows),
        note=_BOUND if any(entry.upper_bound for entry in entries) else "",
        median=f"{entries[0].median:.5g}",
        sources="../calibration.md#known-cameras",
    )


if __name__ == "__main__":
    write(*map(Path, sys.argv[1:2]))
