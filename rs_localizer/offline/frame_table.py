# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of recordings as one table: a row a frame, refused ones too (Arrow, Parquet)."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.atomic_files import atomic_files, write_errors
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_files import pixel_intrinsics
from rs_localizer.io.outputs import Localized
from rs_localizer.offline.replay import NO_FRAMES, prepare_replay, replay
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.pose_at_time import middle_row_ns, pose_at
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.settings import build, load_params_file, unknown

if TYPE_CHECKING:  # an extra
    from pyarrow import Schema, Table

LOCALIZED, REFUSED = "localized", "refused"
"""States of a frame."""

COLUMNS = {
    "recording": "string",
    "stamp_ns": "int64",
    "state": "string",
    "reason": "string",
    "pose_stamp_ns": "int64",
    "map_frame": "string",
    "body_frame": "string",
    **dict.fromkeys(("x", "y", "z", "qx", "qy", "qz", "qw"), "double"),
    "pose_covariance": "list 36",
    **dict.fromkeys(("wx", "wy", "wz", "vx", "vy", "vz"), "double"),
    "twist_covariance": "list 36",
    "points": "int32",
    "inliers": "int32",
    "residual": "double",
    "tracked": "bool_",
    "camera": "string",
    **dict.fromkeys(("first_row", "middle_row", "last_row"), "list 7"),
}
"""Names and types; list: this many doubles (docs/recordings.md says more)."""

_ROWS = 1000  # that are Python's objects before they become Arrow's


def schema() -> Schema:
    """Return the columns of all tables.

    Raises:
        ImportError: without pyarrow.
    """
    import pyarrow as pa

    def arrow(kind: str) -> Any:
        if kind.startswith("list"):
            return pa.list_(pa.float64(), int(kind.split()[1]))
        return pa.float64() if kind == "double" else getattr(pa, kind)()

    always = ("recording", "stamp_ns", "state")
    return pa.schema(
        [pa.field(name, arrow(kind), nullable=name not in always) for name, kind in COLUMNS.items()]
    )


class FrameTable:
    """Rows of one recording, as its frames come.

    Args:
        recording: the place, as the column says it.
        localizer: that makes the frames; it has their camera.
        smoothed: whether each frame is centred on its own moment instead of the middle row.
    """

    def __init__(
        self, recording: Path | str, localizer: FrameLocalizer, smoothed: bool = False
    ) -> None:
        self._schema = schema()
        self._recording = os.path.abspath(recording)
        self._localizer, self._smoothed = localizer, smoothed
        self._rows: list[dict[str, Any]] = []
        self._batches: list[Any] = []

    def add(self, stamp_ns: int, result: Localized | Refusal) -> None:
        """Take what became of the frame with this stamp."""
        row: dict[str, Any] = {"recording": self._recording, "stamp_ns": stamp_ns}
        if result:
            row |= _localized(result) | self._at_rows(result)
        else:
            row |= {"state": REFUSED, "reason": str(result.reason)}
        self._rows.append(row)
        if len(self._rows) == _ROWS:
            self._flush()

    def _at_rows(self, frame: Localized) -> dict[str, Any]:
        """Return the camera, and its pose at the first, the middle and the last row."""
        config, calibration = self._localizer.config, self._localizer.calibration
        assert calibration is not None  # without one there is no frame
        camera = calibration.camera(config.readout_time, config.scan_direction)
        middle_ns = middle_row_ns(config, camera, frame.input_stamp_ns)
        width, height = camera.size
        tau = camera.row_time(np.array([[0.0, 0.0], [width - 1.0, height - 1.0]]))
        first, last = sorted(tau.tolist())
        of_estimate = 0.0
        if self._smoothed and config.readout_time > 0.0:
            of_estimate = (middle_ns - frame.stamp_ns) * 1e-9 / config.readout_time
        rows = {"first_row": first, "middle_row": 0.5 * (first + last), "last_row": last}
        delay = (middle_ns - frame.input_stamp_ns) * 1e-9
        exposed = [delay + config.readout_time * tau for tau in (first, last)]
        poses = {name: pose_at(frame.estimate, tau + of_estimate) for name, tau in rows.items()}
        return {"camera": _as_json(camera, exposed)} | {
            name: [*pose.position.tolist(), *_quaternion(pose.rotation)]
            for name, pose in poses.items()
        }

    def _flush(self) -> None:
        import pyarrow as pa

        self._batches.append(pa.RecordBatch.from_pylist(self._rows, self._schema))
        self._rows = []

    def table(self) -> Table:
        """Return all rows in the order of their stamps."""
        import pyarrow as pa

        self._flush()
        return pa.Table.from_batches(self._batches, self._schema).sort_by("stamp_ns")


def _as_json(camera: Camera, exposed: list[float]) -> str:
    """Describe lens and shutter of the delivered image; its first pixel centre is at 0, 0."""
    (fx, fy), (cx, cy) = (values.tolist() for values in pixel_intrinsics(camera))
    width, height = camera.size
    return json.dumps({
        "width": width, "height": height, "fx": fx, "fy": fy, "cx": cx - 0.5, "cy": cy - 0.5,
        "distortion_model": str(camera.distortion_model), "D": camera.D.tolist(),
        "scan_direction": str(camera.scan_direction),
        "first_row_s": exposed[0], "last_row_s": exposed[1],
    })  # fmt: skip


def _quaternion(rotation: Array) -> list[float]:
    return [float(part) for part in so3.quaternion(np.ascontiguousarray(rotation))]


def _localized(frame: Localized) -> dict[str, Any]:
    pose, twist, estimate = frame.pose, frame.known_twist, frame.estimate
    inliers = int(np.count_nonzero(estimate.inliers))
    row = {
        "state": LOCALIZED,
        "pose_stamp_ns": frame.stamp_ns,
        "map_frame": frame.map_frame,
        "body_frame": frame.body_frame,
        **dict(zip("xyz", pose.position.tolist(), strict=True)),
        **dict(zip(("qx", "qy", "qz", "qw"), _quaternion(pose.rotation), strict=True)),
        "pose_covariance": pose.covariance.ravel().tolist(),
        "points": len(estimate.inliers),
        "inliers": inliers,
        "residual": float(estimate.residual_rms) if inliers else None,  # none where bridged
        "tracked": bool(estimate.tracked),
    }
    if twist is not None:
        row |= zip(("wx", "wy", "wz"), twist.angular.tolist(), strict=True)
        row |= zip(("vx", "vy", "vz"), twist.linear.tolist(), strict=True)
        row["twist_covariance"] = twist.covariance.ravel().tolist()
    return row


def write_parquet(tables: Iterable[Table], place: Path) -> str:
    """Write tables one after the other into one Parquet file; return a sentence on it.

    The bytes depend on the rows and the version of pyarrow: each table is a row group.

    Raises:
        OutputError: when it cannot be written.
        ImportError: without pyarrow.
    """
    import pyarrow.parquet as pq

    rows = 0
    with write_errors(place):
        place.parent.mkdir(parents=True, exist_ok=True)
    with (
        atomic_files(place) as (part,),
        pq.ParquetWriter(part, schema(), compression="zstd") as writer,
    ):
        for table in tables:
            rows += table.num_rows
            writer.write_table(table.combine_chunks(), row_group_size=max(table.num_rows, 1))
    return f"written to {place}: {rows} rows, one a frame"


def localize_recording(
    source: Path | str,
    map: Path | str | None = None,  # noqa: A002  (what users call it)
    settings: Mapping[str, Any] | Path | str | None = None,
) -> Table:
    """Localize each frame of a recording, as ``replay`` does; a table with a row a frame.

    A pure function that can be pickled: for Dask, Ray, Spark and shell loops. Same content, same
    arguments: the same bytes, in whichever process. Progress and notices are not printed.

    Args:
        source: the recording.
        map: map for keypoints; None: the one of the recording, if it has one.
        settings: parameters by dotted name (``{"readout_time": 0.03}``), or a params file.

    Returns:
        a pyarrow.Table; docs/recordings.md has its columns. Refused frames have a reason and no
        pose.

    Raises:
        ValueError: for a recording, map or settings that cannot be used.
        ImportError: without pyarrow (``pip install 'rs_localizer[table]'``).
    """
    values: dict[str, Any] = {}
    if isinstance(settings, Mapping):
        values = dict(settings)
        if faults := [fault for name in values if (fault := unknown(name))]:
            raise ValueError(f"settings: {faults[0]}")
    elif settings is not None:
        values = load_params_file(Path(settings))
    config = build(values if map is None else values | {"map_file": str(map)})
    if config.of_cameras:
        raise ValueError("a table is of one camera: leave the setting cameras out")
    with open_bag(Path(source)) as bag:
        topics, localizer = prepare_replay(bag, config)
        rows = FrameTable(source, localizer)
        for frame in replay(bag, topics, localizer):
            if frame.result or frame.result.reason not in NO_FRAMES:
                rows.add(frame.stamp_ns, frame.result)
    return rows.table()
