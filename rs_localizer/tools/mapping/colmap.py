# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The first structure of a scene, by COLMAP: where keyframes were, what they show, and the lens.

Extraction, matching, incremental mapping and self-calibration are COLMAP's with its defaults
(J. L. Schoenberger, J.-M. Frahm, Structure-from-Motion Revisited, CVPR 2016), in a process of its
own. It assumes a global shutter: the structure is bent as far as the shutter's distortions look
like depth, and is a start for :mod:`.refine`. It has a scale and axes of its own.
"""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.io.camera_files import colmap_camera, colmap_parameters
from rs_localizer.io.maps.colmap import read_colmap
from rs_localizer.tools.mapping import MappingError
from rs_localizer.tools.mapping.gauge import Similarity

DATABASE, SPARSE = "database.db", "sparse"
_ARRAYS, _TASK = "arrays.npz", "task.json"
_SCRIPT = Path(__file__).with_name("colmap_process.py")
# So few images are matched each with each (COLMAP's exhaustive matching: 435 pairs take 20 s on
# two cores); of more, each with so many that follow it, and with those 2^k later (its
# sequential matching), and every n-th with every n-th, so many of them: there loops close.
_EXHAUSTIVE, _OVERLAP = 30, 10
# COLMAP has the corner of the first pixel at 0, 0; here that is its centre.
HALF = 0.5

Stage = Callable[[str, int], AbstractContextManager[Callable[[int], object]]]


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """Poses of views, points, and which views show them where."""

    views: IntArray  # (k,) rows of the views that have a pose
    rotations: Array  # (k,3,3) world_from_camera
    positions: Array  # (k,3) of the camera centres
    points: Array  # (p,3)
    descriptors: NDArray[np.float32]  # (p,128)
    seen_points: IntArray  # (n,) rows of points
    seen_views: IntArray  # (n,) rows of the views
    pixels: Array  # (n,2) raw
    camera: Camera  # lens as given, or as COLMAP calibrated it; without a readout time
    parts: tuple[int, ...]  # views of each part that hangs together, the largest first: this one
    error: float  # px, mean reprojection error of COLMAP's model

    def moved(self, similarity: Similarity) -> Structure:
        """The same in another frame."""
        return replace(
            self,
            rotations=similarity.rotation @ self.rotations,
            positions=similarity(self.positions),
            points=similarity(self.points),
        )


@dataclass(frozen=True, slots=True)
class Effort:
    """How much work is done, and how."""

    threads: int = 1  # of COLMAP's mapping; with more than one, the last digits vary
    seed: int = 0
    # Of an image. COLMAP's own 8192 take sixteen times as long to match as 2048, all in all 213 s
    # of CPU on half of 103 images of 800x600.
    features: int = 2000
    # Keypoints of a view that are adjusted: more say little more, and cost time.
    adjusted: int = 150


def require() -> None:
    """Raise ImportError where pycolmap is not installed, before any work is done."""
    # It is not imported here: see the process of its own.
    if sys.modules.get("pycolmap", ...) is None or importlib.util.find_spec("pycolmap") is None:
        raise ModuleNotFoundError("No module named 'pycolmap'", name="pycolmap")


def image_name(row: int) -> str:
    """The file of a view's image."""
    return f"{row:08d}.jpg"


def build_structure(
    images: Path, keyframes: IntArray, lens: Camera | None, folder: Path, effort: Effort,
    stage: Stage,
) -> Structure:  # fmt: skip
    """Reconstruct the largest part of the keyframes that hangs together.

    Args:
        images: folder with the images of the keyframes, by :func:`image_name`.
        keyframes: (k,) rows of the views.
        lens: of all images, which is believed; None: COLMAP calibrates a simple radial camera.
        folder: for COLMAP's database and model; they stay.
        effort: threads and seed.
        stage: a context for each part of the work: its name and number of steps in, what counts
            them out.

    Raises:
        MappingError: when the images do not determine a structure, or COLMAP fails, saying why.
    """
    task = {
        "images": str(images),
        "folder": str(folder),
        "names": [image_name(row) for row in keyframes.tolist()],
        "pairs": pairs_of(len(keyframes)),
        "camera": None if lens is None else colmap_parameters(lens),
        "features": effort.features,
        "seed": effort.seed,
        "threads": effort.threads,
    }
    (folder / _TASK).write_text(json.dumps(task), encoding="utf-8")
    _run(folder / _TASK, stage)
    (folder / _TASK).unlink()
    with np.load(folder / _ARRAYS) as arrays:
        output = dict(arrays)
    (folder / _ARRAYS).unlink()
    if not output["parts"].size:
        raise MappingError(_nothing(output, len(keyframes)))
    return _structure(output, folder, lens)


def pairs_of(count: int) -> list[tuple[int, int]]:
    """Pairs ``i < j`` of so many images in the order of time that are worth matching."""
    if count <= _EXHAUSTIVE:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    steps = {*range(1, _OVERLAP + 1), *(2**k for k in range(_OVERLAP))}
    pairs = {(i, i + step) for i in range(count) for step in steps if i + step < count}
    every = range(0, count, -(-count // _EXHAUSTIVE))
    return sorted(pairs | {(i, j) for i in every for j in every if i < j})


def _run(task: Path, stage: Stage) -> None:
    """Do the task; a process that dies is named with the last that it said."""
    command = [sys.executable, str(_SCRIPT), str(task)]
    # Else a script imports from its own folder first.
    environment = os.environ | {"PYTHONSAFEPATH": "1"}
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
            process.wait()
        finally:
            process.kill()
        if process.returncode:
            log.seek(0)
            lines = [line for line in log.read().splitlines() if line.strip()]
            raise MappingError(_death(process.returncode, lines[-1] if lines else ""))


def _death(code: int, last: str) -> str:
    how = f"exit code {code}" if code > 0 else f"signal {signal.Signals(-code).name}"
    return f"COLMAP's process ended with {how}" + (f": {last}" if last else "")


def _nothing(output: dict[str, Any], keyframes: int) -> str:
    """Why there is no structure."""
    return (
        f"no two of the {keyframes} keyframes determine a structure "
        f"({output['features'] / keyframes:.0f} features each, {output['pairs']} pairs of them "
        "agree): the images need texture that does not repeat, overlap, and a camera that moves "
        "sideways, not one that only rotates"
    )


def _structure(output: dict[str, Any], folder: Path, lens: Camera | None) -> Structure:
    described = read_colmap(folder / SPARSE, "map", folder / DATABASE)
    assert described.ids is not None
    assert described.descriptors is not None
    order = np.argsort(described.ids)
    rows = np.array([int(Path(name).stem) for name in output["names"].tolist()])
    return Structure(
        views=rows,
        rotations=output["rotations"],
        positions=output["positions"],
        points=output["points"],
        descriptors=described.descriptors[order].astype(np.float32),
        seen_points=output["tracks"][:, 0],
        seen_views=rows[output["tracks"][:, 1]],
        pixels=output["pixels"] - HALF,
        camera=lens or colmap_camera(str(output["camera"]), None),
        parts=tuple(output["parts"].tolist()),
        error=float(output["error"]),
    )
