# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A table of replay -> a recording of the Rerun viewer: path, covariances, images, velocities.

    rs_localizer replay seen --params seen/parameters.yaml --parquet seen.parquet
    python examples/to_rerun.py seen.parquet seen.rrd && rerun seen.rrd

Images are shown where the recording has them (``detect --images``). The ellipsoid holds the
position with 95 %; the orange line is the way of the camera's centre during the readout.
"""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from read_table import Shot, intrinsics, read_table, write_images
from scipy.spatial.transform import Rotation
from script import one_line, run

with one_line():
    import rerun as rr

# 95 % of the chi-square distribution with three degrees of freedom.
WITHIN = np.sqrt(7.8147)
ORANGE, BLUE = (240, 150, 0), (70, 130, 255)


def ellipsoid(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Half sizes (3,) m and quaternion (4,) x y z w of where 95 % of the positions lie."""
    values, axes = np.linalg.eigh(covariance)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return WITHIN * np.sqrt(np.maximum(values, 0.0)), Rotation.from_matrix(axes).as_quat()


def log(stream: Any, shot: Shot) -> None:
    """All of one image but the image itself."""
    row = shot.columns
    stream.set_time("stamp", timestamp=np.datetime64(shot.stamp_ns, "ns"))
    pose = rr.Transform3D(translation=shot.middle[:3, 3], mat3x3=shot.middle[:3, :3])
    stream.log("map/camera", pose)
    covariance = np.array(row["pose_covariance"]).reshape(6, 6)
    half_sizes, quaternion = ellipsoid(covariance[:3, :3])
    stream.log(
        "map/covariance",
        rr.Ellipsoids3D(
            centers=[[row["x"], row["y"], row["z"]]], half_sizes=[half_sizes],
            quaternions=[rr.Quaternion(xyzw=quaternion)], colors=ORANGE,
        ),
    )  # fmt: skip
    way = [shot.first[:3, 3], shot.middle[:3, 3], shot.last[:3, 3]]
    stream.log("map/readout", rr.LineStrips3D([way], colors=ORANGE))
    deviations = np.sqrt(np.diag(covariance))
    curves = {
        "position deviation (mm)": [1e3 * np.linalg.norm(deviations[:3])],
        "orientation deviation (mrad)": [1e3 * np.linalg.norm(deviations[3:])],
        "inliers": [row["points"], row["inliers"]],
    }
    if row["wx"] is not None:
        curves["angular velocity (rad/s)"] = [row[name] for name in ("wx", "wy", "wz")]
        curves["linear velocity (m/s)"] = [row[name] for name in ("vx", "vy", "vz")]
    if row["residual"] is not None:
        curves["residual (px rms)"] = [row["residual"]]
    for name, values in curves.items():
        stream.log(["plots", name], rr.Scalars(values))  # parts: names have blanks


def main(table: str, out: str) -> None:
    """Write the recording."""
    camera, shots = read_table(table)
    stream = rr.RecordingStream("rs_localizer", recording_id=Path(table).stem)
    stream.save(out)
    path = [shot.middle[:3, 3] for shot in shots]
    stream.log("map/path", rr.LineStrips3D([path], colors=BLUE, radii=-1.0), static=True)
    size = camera["width"], camera["height"]
    pinhole = rr.Pinhole(
        image_from_camera=intrinsics(camera), resolution=size,
        camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=0.3,
    )  # fmt: skip
    stream.log("map/camera/image", pinhole, static=True)
    with tempfile.TemporaryDirectory() as folder:
        for shot, name in zip(shots, write_images(shots, Path(folder)), strict=True):
            log(stream, shot)
            image = Path(folder) / name
            if image.is_file():
                kind = f"image/{image.suffix[1:].replace('jpg', 'jpeg')}"
                content = rr.EncodedImage(contents=image.read_bytes(), media_type=kind)
                stream.log("map/camera/image", content)
    stream.flush()
    stream.disconnect()
    print(f"{out}: {len(shots)} images")


if __name__ == "__main__":
    run(main, "TABLE.parquet OUT.rrd    (the table: rs_localizer replay --parquet)")
