# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""telemetry-parser at work, run by its path (see ``limited.py``): a video -> its numbers and words.

The library believes the sizes that a file claims: damaged files cause gigabytes and panics of its
Rust. The reader of the result checks it; this process only makes arrays of it.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np


def extract(parser: Any) -> dict[str, Any]:
    """Extract readings, orientations and metadata of a ``telemetry_parser.Parser``.

    Returns:
        ``gyroscope`` and ``accelerometer`` (n,4) ms and three numbers, ``turns`` (k,5) ms and
        x y z w, and ``said``, JSON of the camera's ``name`` and of ``values`` by their names.
    """
    samples, tags = parser.normalized_imu(), parser.telemetry(False)
    groups = [group for group in tags if isinstance(group, dict)]
    parts = [part for group in groups if isinstance(part := group.get("Quaternion"), dict)]
    rows = [row for part in parts if isinstance(data := part.get("Data"), list) for row in data]
    turns = [[row["t"], *(row["v"][axis] for axis in "xyzw")] for row in rows]
    said = {
        "name": " ".join(dict.fromkeys(f"{parser.camera} {parser.model or ''}".split())),
        "values": _values(groups),
    }
    return {
        "gyroscope": _readings(samples, "gyro"),
        "accelerometer": _readings(samples, "accl"),
        "turns": np.array(turns, float).reshape(-1, 5),
        "said": json.dumps(said, default=str),
    }


def _readings(samples: list[dict[str, Any]], name: str) -> Any:
    rows = [(item["timestamp_ms"], *item[name]) for item in samples if item[name] is not None]
    return np.array(rows, float).reshape(-1, 4)


def _values(groups: list[dict[str, Any]]) -> dict[str, Any]:
    """Return values by name from all groups; of one name, and of a list, the first."""
    found: dict[str, Any] = {}
    for part in reversed([part for group in groups for part in group.values()]):
        if isinstance(part, dict):
            nested = [item for item in part.values() if isinstance(item, dict)]
            for items in (*nested, part):
                first = {k: v[0] if isinstance(v, list) and v else v for k, v in items.items()}
                found |= {k: v for k, v in first.items() if isinstance(v, (str, int, float))}
    return found


def main(path: str, out: str) -> None:
    try:
        import telemetry_parser

        np.savez(out, **extract(telemetry_parser.Parser(path)))
    except BaseException as error:  # panics of its Rust are none of Exception's
        sys.exit(" ".join(str(error).split()) or type(error).__name__)


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))["path"], sys.argv[2])
