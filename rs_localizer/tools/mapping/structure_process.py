# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""COLMAP at work, in a process of its own: ``python structure_process.py TASK.json``.

OpenCV and pycolmap in one process abort on some machines ("free(): invalid pointer"), so this file
imports nothing of this package and is run by its path; it leaves a model and its database. On
standard output it says ``stage NAME TOTAL`` and ``step COUNT`` as it goes, at last ``result JSON``.
"""

import json
import sqlite3
import sys
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pycolmap

DATABASE, SPARSE = "database.db", "sparse"
# Errors of COLMAP's log that say what raised the exception anyway are left out.
_ONLY_FATAL = 3
# Images and pairs of images between two steps of the progress bar.
_IMAGES_AT_ONCE, _PAIRS_AT_ONCE = 8, 25


def main(task: dict[str, Any]) -> None:
    """Extract, match and map the images of a task, and write the largest model.

    Args:
        task: ``images`` and ``folder`` (paths), ``names`` of the images, ``pairs`` of rows of them,
            ``camera`` (COLMAP's model and parameters; null: one simple radial camera, which COLMAP
            calibrates), ``features`` of an image, ``seed`` and ``threads`` of the mapping.
    """
    pycolmap.logging.minloglevel = _ONLY_FATAL
    pycolmap.set_random_seed(task["seed"])
    folder = Path(task["folder"])
    database = folder / DATABASE
    _extract(task, database)
    _match(task, database)
    ordered = _map(task, database, folder)
    result = {"parts": [model.num_reg_images() for model in ordered]}
    if ordered:
        (folder / SPARSE).mkdir()
        ordered[0].write(folder / SPARSE)
    with closing(sqlite3.connect(database)) as tables:
        # Readers of a database with a write-ahead log leave files beside it.
        tables.execute("PRAGMA journal_mode=DELETE")
    _say("result", json.dumps(result))


def _say(*words: object) -> None:
    sys.stdout.write(" ".join(map(str, words)) + "\n")
    sys.stdout.flush()


def _extract(task: dict[str, Any], database: Path) -> None:
    images, names, camera = task["images"], task["names"], task["camera"]
    reader = pycolmap.ImageReaderOptions()
    if camera is not None:
        reader.camera_model = camera["model"]
        reader.camera_params = ",".join(repr(value) for value in camera["params"])
    single = pycolmap.CameraMode.SINGLE
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = task["features"]
    with pycolmap.Database.open(database):
        pass  # which creates it
    pycolmap.import_images(database, images, single, names, reader)
    _say("stage", "extract", len(names))
    for start in range(0, len(names), _IMAGES_AT_ONCE):
        some = names[start : start + _IMAGES_AT_ONCE]
        pycolmap.extract_features(database, images, some, single, reader, extraction)
        _say("step", len(some))


def _match(task: dict[str, Any], database: Path) -> None:
    names, pairs = task["names"], task["pairs"]
    wanted = pycolmap.ImportedPairingOptions()
    wanted.match_list_path = database.with_name("pairs.txt")
    verified = pycolmap.TwoViewGeometryOptions()
    verified.ransac.random_seed = task["seed"]
    _say("stage", "match", len(pairs))
    for start in range(0, len(pairs), _PAIRS_AT_ONCE):
        some = pairs[start : start + _PAIRS_AT_ONCE]
        lines = [f"{names[i]} {names[j]}\n" for i, j in some]
        wanted.match_list_path.write_text("".join(lines), encoding="utf-8")
        pycolmap.match_image_pairs(database, pairing_options=wanted, verification_options=verified)
        _say("step", len(some))
    wanted.match_list_path.unlink()


def _map(task: dict[str, Any], database: Path, folder: Path) -> list[Any]:
    """Return COLMAP's models, the largest first."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = task["threads"]
    for part in (options, options.mapper, options.triangulation):
        part.random_seed = task["seed"]
    options.extract_colors = False
    # COLMAP drops models of fewer than ten images; a short video has hardly more.
    options.min_model_size = 3
    if task["camera"] is not None:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = False
        options.mapper.abs_pose_refine_extra_params = False
    _say("stage", "map", len(task["names"]))
    # COLMAP's own output, a folder for each part, is not kept.
    with TemporaryDirectory(dir=folder) as parts:
        models = pycolmap.incremental_mapping(
            database, task["images"], parts, options, next_image_callback=lambda: _say("step", 1)
        )
    return sorted(models.values(), key=lambda model: -model.num_reg_images())


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
