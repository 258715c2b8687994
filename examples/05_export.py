# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A recording -> a table -> poses of any row as TUM text, for whatever reads that.

    python examples/05_export.py RECORDING first_row out.txt readout_time:=0.011

Without arguments: the bundled webcam recording. Rows: ``first_row``, ``middle_row``, ``last_row``.
Other formats: ``to_gsplat.py`` and its neighbours, from ``rs_localizer replay --parquet``.
"""

import json

from script import run

import rs_localizer as rsl
from rs_localizer import data

ROWS = ("first_row", "middle_row", "last_row")


def main(recording: str, row: str, out: str, *settings: str) -> None:
    """Localize each image and write its pose, map_from_camera, when a row was exposed."""
    if row not in ROWS:
        raise ValueError(f"the row must be one of {', '.join(ROWS)}, found {row}")
    pairs = (text.split(":=") for text in settings)
    values = {name: json.loads(value) for name, value in pairs}
    table = rsl.localize_recording(recording, settings=values)
    lines = ["# t x y z qx qy qz qw"]
    for image in table.to_pylist():
        if image["state"] == "localized":
            camera = json.loads(image["camera"])
            ends = {"first_row": camera["first_row_s"], "last_row": camera["last_row_s"]}
            after = ends.get(row, sum(ends.values()) / 2)
            pose = " ".join(repr(value) for value in image[row])
            lines.append(f"{image['stamp_ns'] * 1e-9 + after:.9f} {pose}")
    with open(out, "w") as file:
        file.write("\n".join(lines) + "\n")
    print(f"{out}: {len(lines) - 1} of {table.num_rows} images")


if __name__ == "__main__":
    bundled = [str(data.path(data.WEBCAM)), "first_row", "webcam.txt", "readout_time:=0.011"]
    run(main, "RECORDING ROW OUT.txt [NAME:=VALUE ...]    (a setting each)", *bundled)
