# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A model of COLMAP becomes that of a global shutter, against the truth of an own projector."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scenes import READOUT, camera, hand, walk

from rs_localizer.cli.commands import main
from rs_localizer.io.maps.colmap import ModelImage, Points, read_model, write_model
from rs_localizer.tools.mapping.gauge import through

pytest.importorskip("pycolmap")

VIDEO = np.arange(0.0, 1.2, 1.0 / 30.0)
NOISE = 0.3
SIZE = 0.1  # of COLMAP's unit, m: it knows none
# COLMAP in a process of its own: beside OpenCV it aborts on some machines.
_COLMAP = """
import sys, pycolmap
model = pycolmap.Reconstruction(sys.argv[1])
if len(sys.argv) > 2:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = False
    pycolmap.bundle_adjustment(model, options)
    model.write(sys.argv[2])
model.update_point_3d_errors()
print(model.compute_mean_reprojection_error())
"""


def colmap_error(model: Path, adjusted: Path | None = None) -> float:
    """Mean reprojection error (px) of a model by COLMAP; adjusted: after its bundle adjustment."""
    words = [sys.executable, "-c", _COLMAP, str(model), *([] if adjusted is None else [adjusted])]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


@pytest.fixture(scope="module")
def scene():
    return walk(np.random.default_rng(3), VIDEO)


@pytest.fixture(scope="module")
def model(scene, tmp_path_factory) -> Path:
    """What COLMAP makes of the keypoints, with a global shutter."""
    folder = tmp_path_factory.mktemp("model")
    (folder / "start").mkdir()
    (folder / "in").mkdir()
    seen, start = scene.seen, scene.start
    ids = 10 + 3 * np.arange(len(start.points))
    shown = np.bincount(seen.landmarks, minlength=len(ids)) > 1
    images = {}
    for k in range(len(VIDEO)):
        mine = seen.images == k
        # Keypoints without a point, as every image has.
        pixels = np.vstack([seen.pixels[mine] + 0.5, [[5.0, 5.0]]])
        points = np.append(np.where(shown, ids, -1)[seen.landmarks[mine]], -1)
        turn = start.rotations[k].T
        away = -turn @ start.positions[k] / SIZE
        images[f"frame_{k:04d}.png"] = ModelImage(k + 1, 1, turn, away, pixels, points)
    grey = np.full((len(ids), 3), 90, np.uint8)
    described = Points(ids[shown], start.points[shown] / SIZE, grey[shown], np.zeros(shown.sum()))
    write_model(folder / "start", camera(0.0), images, described)
    colmap_error(folder / "start", folder / "in")
    return folder / "in"


def distances(points: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """How far points (n,3) are off, m, but for place and size of the whole."""
    return np.linalg.norm(through(points, truth)(points) - truth, axis=1)


@pytest.mark.parametrize(
    "shutter",
    [("-p", f"readout_time:={READOUT}"), pytest.param((), marks=pytest.mark.bench)],  # estimated
)
def test_the_model_is_that_of_a_global_shutter(scene, model, shutter, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["map", "refine", "--colmap", str(model), str(out), "--rate", "30"]
    assert main([*words, *shutter]) == 0
    said = dict(
        line.split("  ", 1) for line in capsys.readouterr().out.splitlines() if "  " in line
    )
    before, after = (float(word) for word in said["error with a global shutter"].split()[0:5:4])
    # Errors have two dimensions; of each the noise is 0.3 px.
    assert after == pytest.approx(np.sqrt(2.0) * NOISE, rel=0.1)
    assert before > 3.0 * after
    # COLMAP agrees, and has nothing left to adjust.
    assert colmap_error(model) > 3.0 * colmap_error(out)
    (tmp_path / "adjusted").mkdir()
    assert colmap_error(out, tmp_path / "adjusted") > 0.9 * colmap_error(out)
    # The points are where they are in truth, COLMAP's were not.
    points = read_model(out)
    rows = (points.ids - 10) // 3
    assert len(rows) > 0.9 * len(np.unique(scene.seen.landmarks))
    old = read_model(model)
    mine = np.isin(old.ids, points.ids)
    order = np.argsort(old.ids[mine])
    bent = distances(old.points[mine][order], scene.points[np.sort(rows)])
    right = distances(points.points, scene.points[rows])
    assert np.median(right) < 0.3 * np.median(bent)
    assert (points.colors == 90).all()
    # The keypoints are where a global shutter would have seen the points at the middle row's time.
    motion = hand(np.random.default_rng(3))
    rotations, positions = motion.poses(VIDEO + 0.5 * READOUT)
    errors = []
    for name, image in read_model(out).images.items():
        k = int(name[6:10])
        away = (scene.points[(image.points - 10) // 3] - positions[k]) @ rotations[k]
        errors.append(camera(0.0).project(away) + 0.5 - image.pixels)
    errors = np.concatenate(errors)
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(NOISE, rel=0.1)
