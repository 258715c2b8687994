# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A table of replay -> what gsplat's ``rasterization`` takes of a rolling shutter.

    rs_localizer replay seen --params seen/parameters.yaml --smooth --parquet seen.parquet
    python examples/to_gsplat.py seen.parquet splat

``viewmats.npy`` and ``viewmats_rs.npy`` (n,4,4): camera_from_world at the first and at the last
exposed row. ``Ks.npy`` (n,3,3), pixels with the corner of the first one at 0, 0. ``shutter.txt``:
the name of ``rolling_shutter``. ``radial_coeffs.npy`` and so on of a lens with distortion.
``names.txt``, ``images/``: in the same order.
"""

from pathlib import Path

import numpy as np
from read_table import coefficients, intrinsics, read_table, shutter, write_images
from script import run


def main(table: str, out: str) -> None:
    """Write the folder."""
    camera, shots = read_table(table)
    folder = Path(out)
    names = write_images(shots, folder)
    np.save(folder / "viewmats.npy", np.linalg.inv([shot.first for shot in shots]))
    np.save(folder / "viewmats_rs.npy", np.linalg.inv([shot.last for shot in shots]))
    np.save(folder / "Ks.npy", np.tile(intrinsics(camera), (len(shots), 1, 1)))
    for name, values in (coefficients(camera) if any(camera["D"]) else {}).items():
        np.save(folder / f"{name}.npy", np.tile(values, (len(shots), 1)))
    (folder / "names.txt").write_text("".join(f"{name}\n" for name in names))
    (folder / "shutter.txt").write_text(f"{shutter(camera)}\n")
    print(f"{out}: {len(shots)} images")


if __name__ == "__main__":
    run(main, "TABLE.parquet OUT    (the table: rs_localizer replay --parquet)")
