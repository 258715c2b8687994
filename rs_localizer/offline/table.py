# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of recordings as one table: a row a frame, refused ones too (Arrow, Parquet)."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rs_localizer.config import NodeConfig
from rs_localizer.core import so3
from rs_localizer.io.atomic_files import atomic_directory
from rs_localizer.io.bags import open_bag
from rs_localizer.io.outputs import Localized
from rs_localizer.io.remote import Location, is_url, local_copy, placed
from rs_localizer.offline.fleet.task import compiled_elsewhere
from rs_localizer.offline.replay import NO_FRAMES, prepare, replay
from rs_localizer.pipeline.frames import FrameLocalizer
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
    "pose_covariance": "list",
    **dict.fromkeys(("wx", "wy", "wz", "vx", "vy", "vz"), "double"),
    "twist_covariance": "list",
    "points": "int32",
    "inliers": "int32",
    "residual": "double",
    "tracked": "bool_",
}
"""Names and types (docs/integrations.md says more); list: 36 doubles, a 6x6 matrix by rows."""

_ROWS = 1000  # that are Python's objects before they become Arrow's


def schema() -> Schema:
    """Of all tables.

    Raises:
        ImportError: without pyarrow.
    """
    import pyarrow as pa

    matrix = pa.list_(pa.float64(), 36)
    fields = [
        pa.field(
            name,
            matrix if kind == "list" else pa.float64() if kind == "double" else getattr(pa, kind)(),
            nullable=name not in ("recording", "stamp_ns", "state"),
        )
        for name, kind in COLUMNS.items()
    ]
    return pa.schema(fields)


class FrameTable:
    """Rows of one recording, as its frames come.

    Args:
        recording: the place, as the column says it.
    """

    def __init__(self, recording: Location) -> None:
        self._schema = schema()
        self._recording = recording if is_url(recording) else os.path.abspath(recording)
        self._rows: list[dict[str, Any]] = []
        self._batches: list[Any] = []

    def add(self, stamp_ns: int, result: Localized | Refusal) -> None:
        """Take what became of the frame with this stamp."""
        row: dict[str, Any] = {"recording": self._recording, "stamp_ns": stamp_ns}
        if result:
            row |= _localized(result)
        else:
            row |= {"state": REFUSED, "reason": str(result.reason)}
        self._rows.append(row)
        if len(self._rows) == _ROWS:
            self._flush()

    def _flush(self) -> None:
        import pyarrow as pa

        self._batches.append(pa.RecordBatch.from_pylist(self._rows, self._schema))
        self._rows = []

    def table(self) -> Table:
        """All rows in the order of their stamps."""
        import pyarrow as pa

        self._flush()
        return pa.Table.from_batches(self._batches, self._schema).sort_by("stamp_ns")


def _localized(frame: Localized) -> dict[str, Any]:
    pose, twist, estimate = frame.pose, frame.twist, frame.estimate
    quaternion = so3.quaternion(np.ascontiguousarray(pose.rotation))
    inliers = int(np.count_nonzero(estimate.inliers))
    row = {
        "state": LOCALIZED,
        "pose_stamp_ns": frame.stamp_ns,
        "map_frame": frame.map_frame,
        "body_frame": frame.body_frame,
        **dict(zip("xyz", pose.position.tolist(), strict=True)),
        **dict(zip(("qx", "qy", "qz", "qw"), quaternion.tolist(), strict=True)),
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


def write_parquet(tables: Iterable[Table], place: Location) -> int:
    """Write tables one after the other into one Parquet file; how many rows.

    The bytes depend on the rows and the version of pyarrow: each table is a row group.

    Raises:
        ValueError: when it cannot be written.
        ImportError: without pyarrow.
    """
    import pyarrow.parquet as pq

    rows = 0
    with placed(place) as part, pq.ParquetWriter(part, schema(), compression="zstd") as writer:
        for table in tables:
            rows += table.num_rows
            writer.write_table(table.combine_chunks(), row_group_size=max(table.num_rows, 1))
    return rows


def read_parquet(file: Path) -> Table:
    """What :func:`write_parquet` wrote."""
    import pyarrow.parquet as pq

    return pq.read_table(file)


# Of a Zarr group: columns of the table, and how many numbers each frame has.
_ARRAYS: dict[str, tuple[tuple[str, ...], tuple[int, ...]]] = {
    "stamp_ns": (("stamp_ns",), ()),
    "position": (("x", "y", "z"), (3,)),
    "quaternion": (("qx", "qy", "qz", "qw"), (4,)),
    "pose_covariance": (("pose_covariance",), (6, 6)),
    "linear_velocity": (("vx", "vy", "vz"), (3,)),
    "angular_velocity": (("wx", "wy", "wz"), (3,)),
    "twist_covariance": (("twist_covariance",), (6, 6)),
}
ZARR_MARK = ".zgroup"


def write_zarr(tables: Iterable[Table], place: Path) -> int:
    """Write the localized frames of tables, an episode each, as a group of Zarr; how many.

    As replay buffers of robot learning: the group ``data`` has an array for all frames, one episode
    after the other, ``meta/episode_ends`` where each ends (a table without a frame has none), and
    ``meta`` the attribute ``recordings``. Format 2, which all versions of Zarr read.

    Args:
        tables: one a recording.
        place: directory to write; an earlier group is replaced.

    Raises:
        ValueError: when it cannot be written.
        ImportError: without Zarr.
    """
    import zarr

    parts: dict[str, list[Any]] = {name: [] for name in _ARRAYS}
    ends, names = [0], []
    for table in tables:
        rows = [row for row in table.to_pylist() if row["state"] == LOCALIZED]
        if not rows:
            continue
        ends.append(ends[-1] + len(rows))
        names.append(rows[0]["recording"])
        for name, (columns, shape) in _ARRAYS.items():
            kind = np.int64 if name == "stamp_ns" else np.float64
            values = [[_numbers(row[column], shape) for column in columns] for row in rows]
            parts[name].append(np.array(values, kind).reshape(len(rows), *shape))
    earlier = (place / ZARR_MARK).is_file()
    with atomic_directory(place, _clear if earlier else None) as part:
        root = zarr.open_group(str(part), mode="w", zarr_format=2)
        data, meta = root.create_group("data"), root.create_group("meta")
        for name, (_, shape) in _ARRAYS.items():
            empty = np.zeros((0, *shape), np.int64 if name == "stamp_ns" else np.float64)
            data.create_array(name, data=np.concatenate([empty, *parts[name]]))
        meta.create_array("episode_ends", data=np.array(ends[1:], np.int64))
        meta.attrs["recordings"] = names
    return ends[-1]


def _numbers(value: Any, shape: tuple[int, ...]) -> Any:
    """A value of a table; what is not known is NaN."""
    return value if value is not None else np.full(36, np.nan) if len(shape) > 1 else np.nan


def _clear(directory: Path) -> None:
    for item in ("data", "meta"):
        shutil.rmtree(directory / item, ignore_errors=True)
    for file in (ZARR_MARK, ".zattrs", ".zmetadata"):
        (directory / file).unlink(missing_ok=True)


def localize_recording(
    source: Location,
    map: Location | None = None,  # noqa: A002  (what users call it)
    settings: Mapping[str, Any] | Location | None = None,
) -> Table:
    """Localize each frame of a recording, as ``replay`` does; a table with a row a frame.

    A pure function that can be pickled: for Dask, Ray, Spark and jobs of Kubernetes
    (docs/integrations.md). Same content, same arguments: the same bytes, in whichever process.
    Progress and notices are not printed.

    Args:
        source: the recording, a path or a URL of fsspec.
        map: of keypoints, likewise; None: that of the recording, if it has one.
        settings: parameters by dotted name (``{"readout_time": 0.03}``), or a params file.

    Returns:
        a pyarrow.Table; docs/integrations.md has its columns. Refused frames have a reason and no
        pose.

    Raises:
        ValueError: for a recording, map or settings that cannot be used.
        ImportError: without pyarrow, or fsspec for a URL (``pip install 'rs_localizer[table]'``).
    """
    config = _config(map, settings)
    if config.is_rig:
        raise ValueError("a table is of one camera: leave the setting cameras out")
    rows = FrameTable(source)
    with open_bag(source) as bag:
        topics, localizer = prepare(bag, config)
        compiled_elsewhere(f"replay {config.solver}", _warm_up, config)
        localizer.warm_up()
        for frame in replay(bag, topics, localizer):
            if frame.result or frame.result.reason not in NO_FRAMES:
                rows.add(frame.stamp_ns, frame.result)
    return rows.table()


def _warm_up(config: NodeConfig) -> None:
    FrameLocalizer(config).warm_up()


def _config(map_file: Location | None, settings: Mapping[str, Any] | Location | None) -> NodeConfig:
    if settings is None:
        values: dict[str, Any] = {}
    elif isinstance(settings, Mapping):
        values = dict(settings)
        for name in values:
            if (fault := unknown(name)) is not None:
                raise ValueError(f"settings: {fault}")
    else:
        with local_copy(settings) as file:
            values = load_params_file(file)
    if map_file is not None:
        values["map_file"] = str(map_file)
    return build(values)
