"""IMU readings in a CSV file, as EuRoC and TUM VI have them (``imu0/data.csv``).

A reading a line: time in ns, angular velocity x y z in rad/s, specific force x y z in m/s^2;
lines that begin with ``#`` are comments.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, IntArray

_LATEST_NS = 2**63 - 1
_COLUMNS = "time in ns, angular velocity x y z in rad/s, specific force x y z in m/s^2"


class ImuFileError(ValueError):
    """A file that cannot be read; the message names the file, the line, the fault."""


class ImuReadings(NamedTuple):
    """What an IMU measured, in its own axes."""

    stamps_ns: IntArray  # (k,)
    angular_velocities: Array  # (k,3) rad/s
    specific_forces: Array  # (k,3) m/s^2


def read_imu_csv(path: Path) -> ImuReadings:
    """Read the readings of a file.

    Raises:
        ImuFileError: for a file that cannot be read, or is another one, with the line.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise ImuFileError(f"{path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ImuFileError(f"{path} is no text file of readings") from error
    stamps: list[int] = []
    values: list[list[float]] = []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            first, *rest = line.split(",")
            stamp, numbers = int(first), [float(word) for word in rest]
            usable = len(numbers) == 6 and np.isfinite(numbers).all()
            if not (usable and 0 <= stamp <= _LATEST_NS):
                raise ValueError
        except ValueError:
            raise ImuFileError(
                f"{path}, line {number}: must be {_COLUMNS} (headings begin with #); got "
                f"{line[:60]!r}"
            ) from None
        stamps.append(stamp)
        values.append(numbers)
    if not stamps:
        raise ImuFileError(f"{path} has no readings")
    table = np.array(values)
    return ImuReadings(np.array(stamps, np.int64), table[:, :3].copy(), table[:, 3:].copy())
