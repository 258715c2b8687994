# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The first structure of a scene, by COLMAP: poses of keyframes, their observations, and the lens.

Extraction, matching, incremental mapping and self-calibration are COLMAP's with its defaults
(J. L. Schoenberger, J.-M. Frahm, Structure-from-Motion Revisited, CVPR 2016), in a process of its
own. It assumes a global shutter: the structure is bent as far as the shutter's distortions look
like depth, and is a start for :mod:`.refinement`. It has a scale and axes of its own.
"""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.io.camera_files import colmap_parameters
from rs_localizer.io.maps.colmap import DATABASE, Model, read_model
from rs_localizer.tools.mapping import MappingError
from rs_localizer.tools.mapping.map_keypoints import MapObservations, Start

SPARSE, _TASK = "sparse", "task.json"
_SCRIPT = Path(__file__).with_name("structure_process.py")
# Up to this many images, each is matched with each (COLMAP's exhaustive matching: 435 pairs take 20
# s on two cores). Of more images, each is matched with this many that follow it and with those 2^k
# later (its sequential matching), and every n-th with every n-th, this many of them: loops close
# there.
_EXHAUSTIVE, _OVERLAP = 30, 10
# Features of an image. COLMAP's default of 8192 takes sixteen times as long to match as 2048: 213 s
# of CPU in all on half of 103 images of 800x600. With more than one thread of its mapping, the last
# digits vary.
_FEATURES, _THREADS, _SEED = 2000, 1, 0
# COLMAP has the corner of the first pixel at 0, 0; here that is its centre.
HALF = 0.5

Stage = Callable[[str, int], AbstractContextManager[Callable[[int], object]]]


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """Poses of views, points, and which views show them where."""

    views: IntArray  # (k,) rows of the views that have a pose
    seen: MapObservations  # by these views
    start: Start  # points and poses
    descriptors: NDArray[np.float32]  # (p,128)
    camera: Camera  # lens as given, or as COLMAP calibrated it; without a readout time
    parts: tuple[int, ...]  # views of each part that hangs together, the largest first: this one


def require() -> None:
    """Raise ImportError where pycolmap is not installed, before any work is done."""
    # It is not imported here: see the process of its own.
    if sys.modules.get("pycolmap", ...) is None or importlib.util.find_spec("pycolmap") is None:
        raise ModuleNotFoundError("No module named 'pycolmap'", name="pycolmap")


def image_name(row: int) -> str:
    """Return the file of a view's image."""
    return f"{row:08d}.jpg"


def build_structure(
    images: Path, keyframes: Mapping[int, int], lens: Camera | None, folder: Path, stage: Stage
) -> Structure:  # fmt: skip
    """Reconstruct the largest connected part of the keyframes.

    Args:
        images: folder with the images of the keyframes, by :func:`image_name`.
        keyframes: rows of the views, and their stamps, ns.
        lens: of all images, which is believed; None: COLMAP calibrates a simple radial camera.
        folder: for COLMAP's database and model; they stay.
        stage: a context for each part of the work: its name and number of steps in, what counts
            them out.

    Raises:
        MappingError: when the images do not determine a structure, or COLMAP fails, saying why.
    """
    task = {
        "images": str(images),
        "folder": str(folder),
        "names": [image_name(row) for row in keyframes],
        "pairs": pairs_of(len(keyframes)),
        "camera": None if lens is None else colmap_parameters(lens),
        "features": _FEATURES,
        "seed": _SEED,
        "threads": _THREADS,
    }
    (folder / _TASK).write_text(json.dumps(task), encoding="utf-8")
    said = _run(folder / _TASK, stage)
    (folder / _TASK).unlink()
    if not said["parts"]:
        raise MappingError(_nothing(said, len(keyframes)))
    model = read_model(folder / SPARSE, folder / DATABASE)
    assert model.descriptors is not None
    names = sorted(model.images)
    views = [int(Path(name).stem) for name in names]
    stamps = np.array([keyframes[row] for row in views], np.int64)
    return Structure(
        np.array(views, np.int64),
        *observed(model, names, stamps),
        descriptors=model.descriptors.astype(np.float32),
        camera=lens or model.camera,
        parts=tuple(said["parts"]),
    )


def observed(
    model: Model, names: Sequence[str], stamps_ns: IntArray
) -> tuple[MapObservations, Start]:
    """Return keypoints of a model's images, by their names in order of stamps (g,), and it.

    Raises:
        MappingError: for keypoints of points that are not there.
    """
    images = [model.images[name] for name in names]
    shown = [image.points >= 0 for image in images]
    pairs = list(zip(images, shown, strict=True))
    ids = np.concatenate([image.points[some] for image, some in pairs])
    rows = np.minimum(np.searchsorted(model.ids, ids), len(model.ids) - 1)
    if not len(ids) or np.any(model.ids[rows] != ids):
        raise MappingError("the model's images list no keypoints of its points")
    rotations = np.array([image.rotation.T for image in images])
    translations = np.array([image.translation for image in images])
    seen = MapObservations(
        stamps_ns,
        np.repeat(np.arange(len(images)), [np.count_nonzero(some) for some in shown]),
        rows,
        np.concatenate([image.pixels[some] for image, some in pairs]) - HALF,
    )
    return seen, Start(model.points, rotations, -np.einsum("gij,gj->gi", rotations, translations))


def pairs_of(count: int) -> list[tuple[int, int]]:
    """Return pairs ``i < j`` of this many images in the order of time that are worth matching."""
    if count <= _EXHAUSTIVE:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    steps = {*range(1, _OVERLAP + 1), *(2**k for k in range(_OVERLAP))}
    pairs = {(i, i + step) for i in range(count) for step in steps if i + step < count}
    every = range(0, count, -(-count // _EXHAUSTIVE))
    return sorted(pairs | {(i, j) for i in every for j in every if i < j})


def _run(task: Path, stage: Stage) -> dict[str, Any]:
    """Return the task's result; name a process that dies with the last that it said."""
    command = [sys.executable, str(_SCRIPT), str(task)]
    # Without it a script would import from its own folder first.
    environment = os.environ | {"PYTHONSAFEPATH": "1"}
    result: dict[str, Any] = {}
    with TemporaryFile("w+", encoding="utf-8", errors="replace") as log, subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=log, text=True, env=environment
    ) as process, ExitStack() as stages:  # fmt: skip
        try:
            step: Callable[[int], object] = lambda count: None  # noqa: E731
            assert process.stdout is not None
            for line in process.stdout:
                match line.split():
                    case ["stage", name, total]:
                        stages.close()
                        step = stages.enter_context(stage(name, int(total)))
                    case ["step", count]:
                        step(int(count))
                    case ["result", *_]:
                        result = json.loads(line.removeprefix("result"))
            process.wait()
        finally:
            process.kill()
        if process.returncode:
            log.seek(0)
            lines = [line for line in log.read().splitlines() if line.strip()]
            raise MappingError(_death(process.returncode, lines[-1] if lines else ""))
    return result


def _death(code: int, last: str) -> str:
    how = f"exit code {code}" if code > 0 else f"signal {signal.Signals(-code).name}"
    return f"COLMAP's process ended with {how}" + (f": {last}" if last else "")


def _nothing(output: dict[str, Any], keyframes: int) -> str:
    """Say why there is no structure."""
    return (
        f"no two of the {keyframes} keyframes determine a structure "
        f"({output['features'] / keyframes:.0f} features each, {output['pairs']} pairs of them "
        "agree): the images need texture that does not repeat, overlap, and a camera that moves "
        "sideways, not one that only rotates"
    )
