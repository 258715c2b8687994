# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The images that a map is made from, and the first structure of their scene, by COLMAP.

Extraction, matching, incremental mapping and self-calibration are COLMAP's with its defaults
(J. L. Schoenberger, J.-M. Frahm, Structure-from-Motion Revisited, CVPR 2016), in a process of its
own. It assumes a global shutter: the structure is bent as far as the shutter's distortions look
like depth, and is a start for :mod:`.refinement`. It has a scale and axes of its own.
"""

import importlib.util
import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from rs_localizer.config import FeatureKind
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.features.extraction import FeatureExtractor, Features
from rs_localizer.io.camera_files import colmap_parameters
from rs_localizer.io.images import Image
from rs_localizer.io.maps.colmap import DATABASE, Model, read_model
from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.offline.detect import ImageTally, usable
from rs_localizer.offline.image_sources import Carried, Shot
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
    images: Path, keyframes: Mapping[int, int], lens: Camera | None, folder: Path
) -> Structure:
    """Reconstruct the largest connected part of the keyframes.

    Args:
        images: folder with the images of the keyframes, by :func:`image_name`.
        keyframes: rows of the views, and their stamps, ns.
        lens: of all images, which is believed; None: COLMAP calibrates a simple radial camera.
        folder: for COLMAP's database and model; they stay.

    Raises:
        ValueError: when the images do not determine a structure, or COLMAP fails, saying why.
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
    said = _run(folder / _TASK)
    (folder / _TASK).unlink()
    if not said["parts"]:
        raise ValueError(
            f"no two of the {len(keyframes)} keyframes determine a structure: the images need "
            "texture that does not repeat, overlap, and a camera that moves sideways, not one that "
            "only rotates"
        )
    model = read_model(folder / SPARSE, folder / DATABASE)
    assert model.descriptors is not None
    names = sorted(model.images)
    views = [int(Path(name).stem) for name in names]
    stamps = np.array([keyframes[row] for row in views], np.int64)
    return Structure(
        np.array(views, np.int64), *observed(model, names, stamps),
        descriptors=model.descriptors.astype(np.float32), camera=lens or model.camera,
        parts=tuple(said["parts"]),
    )  # fmt: skip


def observed(
    model: Model, names: Sequence[str], stamps_ns: IntArray
) -> tuple[MapObservations, Start]:
    """Return keypoints of a model's images, by their names in order of stamps (g,), and it.

    Raises:
        ValueError: for keypoints of points that are not there.
    """
    images = [model.images[name] for name in names]
    pairs = [(image, image.points >= 0) for image in images]
    ids = np.concatenate([image.points[some] for image, some in pairs])
    rows = np.minimum(np.searchsorted(model.ids, ids), len(model.ids) - 1)
    if not len(ids) or np.any(model.ids[rows] != ids):
        raise ValueError("the model's images list no keypoints of its points")
    rotations = np.array([image.rotation.T for image in images])
    translations = np.array([image.translation for image in images])
    seen = MapObservations(
        stamps_ns, np.repeat(np.arange(len(images)), [np.count_nonzero(some) for _, some in pairs]),
        rows, np.concatenate([image.pixels[some] for image, some in pairs]) - HALF,
    )  # fmt: skip
    return seen, Start(model.points, rotations, -np.einsum("gij,gj->gi", rotations, translations))


def pairs_of(count: int) -> list[tuple[int, int]]:
    """Return pairs ``i < j`` of this many images in the order of time that are worth matching."""
    if count <= _EXHAUSTIVE:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    steps = {*range(1, _OVERLAP + 1), *(2**k for k in range(_OVERLAP))}
    pairs = {(i, i + step) for i in range(count) for step in steps if i + step < count}
    every = range(0, count, -(-count // _EXHAUSTIVE))
    return sorted(pairs | {(i, j) for i in every for j in every if i < j})


def _run(task: Path) -> dict[str, Any]:
    """Return the task's result; name a process that dies with the last that it said."""
    command = [sys.executable, str(_SCRIPT), str(task)]
    # Without it a script would import from its own folder first.
    environment = os.environ | {"PYTHONSAFEPATH": "1"}
    result: dict[str, Any] = {}
    with TemporaryFile("w+", encoding="utf-8", errors="replace") as log, subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=log, text=True, env=environment
    ) as process, ExitStack() as bars:  # fmt: skip
        try:
            assert process.stdout is not None
            for line in process.stdout:
                match line.split():
                    case ["stage", name, total]:
                        bars.close()
                        bar = bars.enter_context(tqdm(total=int(total), desc=name, disable=None))
                    case ["step", count]:
                        bar.update(int(count))
                    case ["result", *_]:
                        result = json.loads(line.removeprefix("result"))
            process.wait()
        finally:
            process.kill()
        if process.returncode:
            log.seek(0)
            lines = [line for line in log.read().splitlines() if line.strip()]
            code, last = process.returncode, f": {lines[-1]}" if lines else ""
            how = f"exit code {code}" if code > 0 else f"signal {signal.Signals(-code).name}"
            raise ValueError(f"COLMAP's process ended with {how}{last}")
    return result


# JPEG's quality of what COLMAP gets: at this one, errors are below a grey level.
_QUALITY = 97
# A view with fewer features is blurred, dark, or of a blank wall.
_FEW_FEATURES = 50
LEAST_VIEWS = 3
# COLMAP gets all views of a short recording and this many a second of a long one: at a turn of 60
# degrees a second, neighbours have three quarters of a picture of 60 degrees in common.
_KEYFRAMES, _KEYFRAMES_PER_SECOND = 60, 4.0
# Images a hair before their time are in time.
_EARLY = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class SeenImage:
    """Features and markers of an image."""

    stamp_ns: int
    image: Path  # its picture, by :func:`image_name`
    features: Features
    sharpness: float  # the higher the sharper; comparable between views of the same scene
    corners: Array  # (m,2) raw, of the markers
    corner_ids: IntArray  # (m,) rows of the marker map's points


class Looker:
    """Looks at the images of a recording, in their order, and writes them down for COLMAP.

    Args:
        most: features of an image.
        images: folder to write to.
        marker_map: markers to look for, too.
    """

    def __init__(self, most: int, images: Path, marker_map: MarkerMap | None = None) -> None:
        self._extractor = FeatureExtractor(FeatureKind.SIFT, most)
        self._images, self._count = images, 0
        self._detector = None if marker_map is None else MarkerDetector(marker_map)

    def detect_in(self, image: Image) -> SeenImage:
        """Return the view of an image."""
        path = self._images / image_name(self._count)
        self._count += 1
        quality = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
        # Not cv2.imwrite, which says nothing of a full disk.
        path.write_bytes(cv2.imencode(".jpg", image.pixels, quality)[1].tobytes())
        corners, ids = np.zeros((0, 2)), np.zeros(0, np.int64)
        if self._detector is not None:
            detections = self._detector.detect(image.pixels, image.stamp_ns)
            corners, ids = detections.pixels, detections.ids
        features = self._extractor.extract(image.pixels)
        # The fine detail of a picture: grey levels (rms) of the Laplacian.
        sharpness = float(cv2.Laplacian(image.pixels, cv2.CV_32F, ksize=3).std())
        return SeenImage(image.stamp_ns, path, features, sharpness, corners, ids)


@dataclass(slots=True)
class Looked(ImageTally):
    """Views of a recording."""

    views: list[SeenImage] = field(default_factory=list)
    camera: Camera | None = None  # without its readout time; None: nobody has calibrated it
    moments: dict[float, int] = field(default_factory=dict)  # asked for, s -> row of its view


def look_through(
    shots: Iterable[Shot | Carried], looker: Looker, rate: float, moments: Sequence[float]
) -> Looked:
    """Look at the images that are kept: this many a second, and the first ones at or after moments.

    Args:
        moments: s after the first image.

    Raises:
        ValueError: for a camera that changes.
    """
    found = Looked()
    for _, image, camera in usable(shots, ScanDirection.TOP_TO_BOTTOM, found):
        if found.views and camera is not found.camera:
            raise ValueError("the camera changes within the recording; cut it there")
        found.camera = camera
        since = (image.stamp_ns - found.stamps_ns[0]) * 1e-9
        asked = [s for s in moments if s not in found.moments and since >= s - 1e-3]
        found.moments |= dict.fromkeys(asked, len(found.views))
        due_ns = 1e9 * _EARLY / rate
        if asked or not found.views or image.stamp_ns - found.views[-1].stamp_ns >= due_ns:
            found.views.append(looker.detect_in(image))
    return found


def check_views(views: Sequence[SeenImage]) -> None:
    """Refuse (``ValueError``), before minutes of work, views that will make no map."""
    if len(views) < LEAST_VIEWS:
        raise ValueError(f"{len(views)} images make no map; at least {LEAST_VIEWS} are needed")
    features = float(np.median([len(view.features) for view in views]))
    if features < _FEW_FEATURES:
        raise ValueError(
            f"the images show {features:.0f} features each (median), at least {_FEW_FEATURES} are "
            "needed: are they blurred, dark, or of blank walls?"
        )


def choose_keyframes(views: Sequence[SeenImage]) -> IntArray:
    """Return rows (k,) of views for COLMAP: evenly spaced, the sharpest of each few."""
    seconds = 1e-9 * (views[-1].stamp_ns - views[0].stamp_ns)
    count = max(_KEYFRAMES, math.ceil(_KEYFRAMES_PER_SECOND * seconds))
    slots = np.array_split(np.arange(len(views)), min(count, len(views)))
    return np.array([max(slot, key=lambda row: views[row].sharpness) for slot in slots], np.int64)
