# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Planted bugs: signs, axes, units, frames, dropped terms. Each has a test that ought to catch it.

python -m benchmarks.mutants            all of them
python -m benchmarks.mutants telemetry  those of files with this word in their names

A mutant is planted in a copy of the package, which compiles what depends on it.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

_ROOT = Path(__file__).resolve().parents[1]
_LONGEST = 600.0  # s, of the tests of one


class Mutant(NamedTuple):
    """What stands in a file of the package, what is put there instead, and the test."""

    file: str
    old: str
    new: str
    test: str


_POSE, _SHUTTER, _CAMERA = (
    "test/pipeline/test_pose_at_time.py", "test/core/test_shutter.py", "test/core/test_camera.py",
)  # fmt: skip
_SO3, _TF, _OUT = "test/core/test_so3.py", "test/io/transforms", "test/io/test_outputs.py"
_UNITS = "test/core/test_units.py"
MUTANTS = [Mutant(*row) for row in (
    # The five that were found alive.
    ("pipeline/pose_at_time.py", " + 0.25 * delay**2 * change", "", _POSE),
    ("core/types.py", "variance * beyond**2, variance", "variance * beyond, variance", _POSE),
    ("io/telemetry.py", "np.arange(len(forces)) / (len(forces) - 1)",
     "np.arange(len(forces)) / (len(times) - 1)", "test/io/test_telemetry.py"),
    ("core/camera.py", "offset if sign > 0 else offset + extent - 1",
     "offset if sign > 0 else offset + extent", _CAMERA),
    ("offline/frame_table.py", '"vz"), twist.linear', '"vz"), twist.angular',
     "test/offline/test_frame_table.py -k what_the_messages_say"),
    # And more of their kind.
    ("pipeline/pose_at_time.py", "pose.rotation @ twist.linear, ", "twist.linear, ", _POSE),
    ("pipeline/pose_at_time.py", "[acceleration.linear, acceleration.angular]",
     "[acceleration.angular, acceleration.linear]", _POSE),
    ("pipeline/pose_at_time.py", "covariance=covariance / readout_time**2",
     "covariance=covariance / readout_time", _POSE),
    ("pipeline/pose_at_time.py", "angular=angular / readout_time", "angular=angular", _POSE),
    ("core/types.py", "variance *= 3.0 * (1.0 + 2.0 * beyond) ** 2",
     "variance *= 3.0 * (1.0 + 2.0 * beyond)", _POSE),
    ("pipeline/pose_at_time.py", "config.stamp_offset - config.readout_time * camera",
     "config.stamp_offset + config.readout_time * camera", "test/pipeline/test_frames.py"),
    ("shutter_watch.py", "-2.0 * own", "0.0 * own", "test/pipeline/test_shutter_watch.py"),
    ("pipeline/map_to_odom.py", "[0, 1, 5] if", "[0, 1, 3] if",
     "test/pipeline/test_map_to_odom.py"),
    ("pipeline/map_to_odom.py", "not seen.doubt >= _DOUBTFUL", "True",
     "test/pipeline/test_map_to_odom.py"),
    ("pipeline/carried_pose.py", "there.rotation @ here.rotation.T",
     "there.rotation.T @ here.rotation", "test/pipeline/test_map_to_odom.py"),
    ("pipeline/carried_pose.py", "np.minimum(squared, _MOST)", "squared",
     "test/pipeline/test_map_to_odom.py"),
    ("core/shutter.py", "turn @ (self.translation - self.way_at(tau))",
     "turn @ (self.translation + self.way_at(tau))", _SHUTTER),
    ("core/shutter.py", "turn = so3.exp(-self.angle_at(tau))\n        return turn @ self.rotation",
     "turn = so3.exp(self.angle_at(tau))\n        return turn @ self.rotation", _SHUTTER),
    ("core/shutter.py", " + 0.5 * tau * tau * self.angular_acceleration", "", _SHUTTER),
    ("core/shutter.py", "+ 0.5 * tau * tau * self.linear_acceleration", "", _SHUTTER),
    ("core/shutter.py", "self.linear_velocity + tau * self.linear_acceleration",
     "self.linear_velocity", _SHUTTER),
    ("core/shutter.py", "return so3.exp(-self.angle_at(tau)) @ velocity", "return velocity",
     _SHUTTER),
    ("core/shutter.py", "turn[row, k] * (translation[k] - way)", "turn[row, k] * translation[k]",
     _SHUTTER),
    ("core/shutter.py", "so3.right_jacobian(self.angle_at(tau)) @ rate", "rate", _SHUTTER),
    ("core/units.py", "position=-in_map @ translation", "position=in_map @ translation", _UNITS),
    ("core/units.py", "so3.quaternion(in_map)", "so3.quaternion(in_map.T.copy())", _UNITS),
    ("core/units.py", "motion.linear_velocity_at(tau) / per_readout",
     "motion.linear_velocity_at(tau)", _UNITS),
    ("core/units.py", "np.asarray(self.rotation @ self.linear_velocity)",
     "np.asarray(self.rotation.T @ self.linear_velocity)", _UNITS),
    ("core/camera.py", "sensor = pixels * self.binning + self._offset()\n        if",
     "sensor = pixels * self.binning\n        if", _CAMERA),
    ("core/camera.py", "sign * camera.binning[axis] / (size - 1)",
     "sign * camera.binning[axis] / size", _CAMERA),
    ("core/camera.py", "sign * (camera._offset()[axis] - 0.5 * (size - 1))",
     "sign * (camera._offset()[axis] - 0.5 * size)", _CAMERA),
    ("core/camera.py", "np.array([self.roi.x_offset, self.roi.y_offset]",
     "np.array([self.roi.y_offset, self.roi.x_offset]", _CAMERA),
    ("core/camera.py", "width // self.binning[0], height // self.binning[1]",
     "width // self.binning[1], height // self.binning[0]", _CAMERA),
    ("core/camera.py", "K[0, 0] / binning[0] * K[1, 1] / binning[1]", "K[0, 0] * K[1, 1]",
     _CAMERA),
    ("io/transforms.py", "Transform(self.rotation.T, -self.rotation.T @ self.translation)",
     "Transform(self.rotation.T, -self.translation)", _TF),
    ("io/transforms.py", "self.rotation @ other.translation + self.translation",
     "other.translation + self.translation", _TF),
    ("io/transforms.py", "of_target[meeting].inverse() @ of_source[meeting]",
     "of_source[meeting].inverse() @ of_target[meeting]", _TF),
    ("io/transforms.py", "(1.0 - ratio) * older.translation + ratio * newer.translation",
     "ratio * older.translation + (1.0 - ratio) * newer.translation", _TF),
    ("io/outputs.py", "covariance = frame.pose.covariance.ravel()",
     "covariance = frame.pose.covariance[::-1].ravel()", _OUT),
    ("io/outputs.py", "make_vector(make, twist.linear), make_vector(make, twist.angular)",
     "make_vector(make, twist.angular), make_vector(make, twist.linear)", _OUT),
    ("io/telemetry.py", "times[0] + span * np", "span * np", "test/io/test_telemetry.py"),
    ("offline/frame_table.py", '"wx", "wy", "wz"), twist', '"wy", "wx", "wz"), twist',
     "test/offline/test_frame_table.py -k what_the_messages_say"),
    # Of kernels.
    ("core/so3.py", "matrix[0, 1] = c * x * y - s * z", "matrix[0, 1] = c * x * y + s * z", _SO3),
    ("core/so3.py", "q[1] = matrix[0, 2] - matrix[2, 0]", "q[1] = matrix[2, 0] - matrix[0, 2]",
     _SO3),
    ("core/so3.py", "matrix[2, 0], matrix[2, 1] = -vector[1], vector[0]",
     "matrix[2, 0], matrix[2, 1] = vector[1], vector[0]", _SO3),
    ("core/so3.py", "third * x * y + second * z, third * x * y - second * z",
     "third * x * y - second * z, third * x * y + second * z", _SO3),
    ("core/so3.py", "1.0 - third * (y * y + z * z)", "1.0 - third * (y * y)", _SO3),
    ("estimation/ransac.py", "state[12 + i] = -w[i]", "state[12 + i] = w[i]",
     "test/estimation/test_ransac.py"),
    ("estimation/ransac.py", "w[j] * c[k] - w[k] * c[j] - t[i]", "w[j] * c[k] - w[k] * c[j]",
     "test/estimation/test_ransac.py"),
    ("estimation/posterior.py", "2.0 * np.sum(inliers) - freedom", "2.0 * np.sum(inliers)",
     "test/estimation/test_posterior.py"),
    ("estimation/acceptance.py", "[part, part] @ velocities", "[part, part] @ velocities * 0.0",
     "test/estimation/test_acceptance.py"),
)]  # fmt: skip


def main() -> int:
    words = sys.argv[1:]
    if any(word.startswith("-") for word in words):
        sys.stdout.write(f"{__doc__}\n")
        return 0
    chosen = [mutant for mutant in MUTANTS if all(word in mutant.file for word in words)]
    alive = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in ("rs_localizer", "test", "benchmarks", "config", "docs", "examples"):
            shutil.copytree(_ROOT / name, copy / name)
        for name in ("pyproject.toml", "README.md", "package.xml"):
            shutil.copy(_ROOT / name, copy / name)
        for mutant in chosen:
            caught = _caught(copy, mutant)
            sys.stdout.write(f"{'caught' if caught else 'ALIVE '} {mutant.file}: {mutant.new!r}\n")
            sys.stdout.flush()
            alive += [] if caught else [mutant]
    sys.stdout.write(f"{len(chosen)} planted, {len(chosen) - len(alive)} caught\n")
    return 1 if alive else 0


def _caught(copy: Path, mutant: Mutant) -> bool:
    """Whether the tests fail with it."""
    file = copy / "rs_localizer" / mutant.file
    text = file.read_text(encoding="utf-8")
    if text.count(mutant.old) != 1:
        raise ValueError(f"{mutant.file} has {mutant.old!r} {text.count(mutant.old)} times")
    file.write_text(text.replace(mutant.old, mutant.new), encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": str(copy)}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    try:
        done = subprocess.run(
            [*command, *mutant.test.split()], cwd=copy, env=environment, timeout=_LONGEST,
            capture_output=True, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return False
    finally:
        file.write_text(text, encoding="utf-8")
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{mutant.test}: {done.stdout.decode()[-500:]}")
    return done.returncode == 1


if __name__ == "__main__":
    sys.exit(main())
