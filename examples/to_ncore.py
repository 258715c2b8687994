# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A table of replay -> cameras and frames as NVIDIA's NCore has them, and its sequence.

    rs_localizer replay seen --params seen/parameters.yaml --smooth --parquet seen.parquet
    python examples/to_ncore.py seen.parquet ncore

``ncore.json``: ``camera_model_parameters`` of its pinhole or fisheye, and of each frame
``timestamps_us`` and ``T_sensor_world`` (map_from_camera) at the first and the last exposed row.
Where the package nvidia-ncore is installed (run with 19.8.3), ``sequence`` is written, too.
"""

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
from read_table import Shot, coefficients, intrinsics, read_table, shutter, write_images
from script import run

import rs_localizer as rsl


def told(camera: dict[str, Any], shots: list[Shot], names: list[str]) -> dict[str, Any]:
    """What ``ncore.json`` holds."""
    K, size = intrinsics(camera), [camera["width"], camera["height"]]
    model: dict[str, Any] = {
        "camera_model_type": "opencv-pinhole",
        "resolution": size,
        "shutter_type": shutter(camera),
        "external_distortion_parameters": None,
        "principal_point": K[:2, 2].tolist(),
        "focal_length": [K[0, 0], K[1, 1]],
    }
    if camera["distortion_model"] == "equidistant":
        lens = rsl.Camera(*size, intrinsics(camera, 0.0), camera["D"], "equidistant")
        # All over the image: its corners may show nothing.
        places = np.meshgrid(*(np.linspace(0.0, each - 1.0, 99) for each in size))
        ahead = lens.bearings(np.column_stack([each.ravel() for each in places]))[:, 2]
        model["camera_model_type"] = "opencv-fisheye"
        model["max_angle"] = float(np.arccos(np.nanmin(ahead)))
    ends = [round(1e9 * camera[name]) for name in ("first_row_s", "last_row_s")]
    frames = [
        {
            "file_path": name,
            "timestamps_us": [round((shot.stamp_ns + after) / 1000) for after in ends],
            "T_sensor_world": [shot.first.tolist(), shot.last.tolist()],
        }
        for shot, name in zip(shots, names, strict=True)
    ]
    return {"camera_model_parameters": model | coefficients(camera), "frames": frames}


def write_sequence(folder: Path, content: dict[str, Any]) -> None:
    """NCore's own files."""
    from ncore.data import OpenCVFisheyeCameraModelParameters as Fisheye
    from ncore.data import OpenCVPinholeCameraModelParameters as Pinhole
    from ncore.data.v4 import (
        CameraSensorComponent,
        IntrinsicsComponent,
        PosesComponent,
        SequenceComponentGroupsWriter,
    )
    from ncore.impl.common.transformations import HalfClosedInterval

    lens, frames = dict(content["camera_model_parameters"]), content["frames"]
    model = {"opencv-pinhole": Pinhole, "opencv-fisheye": Fisheye}[lens.pop("camera_model_type")]
    stamps = np.array([frame["timestamps_us"] for frame in frames], np.uint64)
    times, once = np.unique(stamps, return_index=True)
    span = HalfClosedInterval.from_start_end(int(times[0]), int(times[-1]))
    made = SequenceComponentGroupsWriter(folder / "sequence", "flight", "flight", span, {})
    of_lens = made.register_component_writer(IntrinsicsComponent.Writer, "default")
    of_lens.store_camera_intrinsics("camera", model.from_dict(lens))
    poses = np.array([frame["T_sensor_world"] for frame in frames]).reshape(-1, 4, 4)[once]
    of_poses = made.register_component_writer(PosesComponent.Writer, "default")
    of_poses.store_dynamic_pose("camera", "world", poses, times)
    images = made.register_component_writer(CameraSensorComponent.Writer, "camera")
    for frame, pair in zip(frames, stamps, strict=True):
        image = (folder / frame["file_path"]).read_bytes()
        images.store_frame(image, "jpeg", pair, {}, {})
    made.finalize()


def main(table: str, out: str) -> None:
    """Write the folder."""
    camera, shots = read_table(table)
    content = told(camera, shots, write_images(shots, Path(out)))
    (Path(out) / "ncore.json").write_text(json.dumps(content, indent=1))
    if importlib.util.find_spec("ncore") is not None:
        write_sequence(Path(out), content)
    print(f"{out}: {len(shots)} images")


if __name__ == "__main__":
    run(main, "TABLE.parquet OUT    (the table: rs_localizer replay --parquet)")
