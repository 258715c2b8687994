"""The first structure of a scene, by COLMAP: where keyframes were, and what they show.

COLMAP (J. L. Schoenberger, J.-M. Frahm, Structure-from-Motion Revisited, CVPR 2016) assumes a
global shutter: the structure is bent as far as the shutter's distortions look like depth, and is a
start for :mod:`rs_localizer.mapping.refine`. It has a scale and axes of its own.

COLMAP is given the features as a pinhole camera without distortion would see them, its centre of
the first pixel at 0.5, 0.5.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.mapping.errors import MappingError
from rs_localizer.mapping.pairs import choose_pairs
from rs_localizer.mapping.similarity import Similarity
from rs_localizer.mapping.views import View

DATABASE, SPARSE = "database.db", "sparse"
# Matches of two images: fewer that fit one motion (epipolar geometry) are chance.
_LEAST_MATCHES = 15
# How far (px) a match may be off a global shutter's geometry: a rolling shutter bends by as much.
_MOST_ERROR = 6.0
# Pairs that are matched at once, between two steps of the progress bar.
_PAIRS_AT_ONCE = 100
# Errors of COLMAP's log that say what raised the exception anyway are left out.
_ONLY_FATAL = 3

Stage = Callable[[str, int], AbstractContextManager[Callable[[int], object]]]


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """Poses of views, points, and which feature of which view shows which point."""

    views: IntArray  # (k,) rows of the views that have a pose
    rotations: Array  # (k,3,3) world_from_camera
    positions: Array  # (k,3) of the camera centres
    points: Array  # (p,3)
    seen_points: IntArray  # (n,) rows of points
    seen_views: IntArray  # (n,) rows of the views
    seen_features: IntArray  # (n,) rows of the views' pixels
    parts: tuple[int, ...]  # views of each part that hangs together, the largest first: this one

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

    threads: int = 1  # of COLMAP; with more than one, the last digits vary
    seed: int = 0
    # Keypoints of a view that are adjusted: more say little more, and cost time.
    adjusted: int = 150


def require() -> None:
    """Raise ImportError where pycolmap is not installed, before any work is done."""
    importlib.import_module("pycolmap")


def build_structure(
    views: Sequence[View],
    keyframes: IntArray,
    camera: Camera,
    folder: Path,
    effort: Effort,
    stage: Stage,
) -> Structure:
    """Match the keyframes, and reconstruct the largest part that hangs together.

    Args:
        views: of the recording.
        keyframes: (k,) their rows.
        camera: of all views; its lens is believed.
        folder: for COLMAP's database and model; it stays.
        effort: threads and seed.
        stage: a context for each part of the work: its name and number of steps in, what counts
            them out.

    Raises:
        ImportError: without pycolmap.
        MappingError: when the images do not determine a structure, saying why.
    """
    import pycolmap

    pycolmap.logging.minloglevel = _ONLY_FATAL
    pycolmap.set_random_seed(effort.seed)
    database = folder / DATABASE
    names = _write_database(pycolmap, database, views, keyframes, camera)
    pairs = choose_pairs([views[row].features for row in keyframes.tolist()])
    with stage("match", len(pairs)) as step:
        for start in range(0, len(pairs), _PAIRS_AT_ONCE):
            some = pairs[start : start + _PAIRS_AT_ONCE]
            _match(pycolmap, database, [(names[i], names[j]) for i, j in some], effort)
            step(len(some))
    options = _pipeline(pycolmap, effort)

    def advance() -> None:
        step(1)

    # What COLMAP writes on its own, a folder for each part, is not kept.
    with stage("map", len(keyframes)) as step, TemporaryDirectory(dir=folder) as parts:
        models = pycolmap.incremental_mapping(
            database, folder, parts, options, next_image_callback=advance
        )
    if not models:
        raise MappingError(_nothing(pycolmap, database, len(keyframes)))
    ordered = sorted(models.values(), key=lambda model: -model.num_reg_images())
    (folder / SPARSE).mkdir()
    ordered[0].write(folder / SPARSE)
    return _structure(ordered[0], tuple(model.num_reg_images() for model in ordered))


def _write_database(
    pycolmap: Any, path: Path, views: Sequence[View], keyframes: IntArray, camera: Camera
) -> list[str]:
    """Camera, images and features; the names of the images, which are the rows of the views."""
    width, height = camera.size
    focal, middle = camera.focal_length, 0.5 * np.array([width, height])
    pinhole = pycolmap.Camera(
        model="PINHOLE", width=width, height=height, params=[focal, focal, *middle.tolist()]
    )
    pinhole.has_prior_focal_length = True
    names = []
    with pycolmap.Database.open(path) as database:
        pinhole.camera_id = database.write_camera(pinhole)
        rig = pycolmap.Rig()
        rig.add_ref_sensor(pinhole.sensor_id)
        rig_id = database.write_rig(rig)
        for row in keyframes.tolist():
            image = pycolmap.Image(name=f"{row:08d}", camera_id=pinhole.camera_id)
            image.image_id = database.write_image(image)
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            frame.add_data_id(image.data_id)
            database.write_frame(frame)
            rays = camera.rays(views[row].features.pixels)
            # What the lens model has no bearing for lies far off, and matches nothing.
            pixels = np.nan_to_num(focal * rays + middle, nan=-1e6).astype(np.float32)
            database.write_keypoints(image.image_id, pixels)
            described = pycolmap.FeatureDescriptors(
                pycolmap.FeatureExtractorType.SIFT, views[row].features.descriptors
            )
            database.write_descriptors(image.image_id, described)
            names.append(image.name)
    return names


def _match(pycolmap: Any, database: Path, pairs: list[tuple[str, str]], effort: Effort) -> None:
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads, matching.use_gpu = effort.threads, False
    listed = database.with_name("pairs.txt")
    listed.write_text("".join(f"{one} {other}\n" for one, other in pairs), encoding="utf-8")
    wanted = pycolmap.ImportedPairingOptions()
    wanted.match_list_path = listed
    verified = pycolmap.TwoViewGeometryOptions()
    verified.min_num_inliers = _LEAST_MATCHES
    verified.ransac.max_error, verified.ransac.random_seed = _MOST_ERROR, effort.seed
    pycolmap.match_image_pairs(database, matching, wanted, verified, pycolmap.Device.cpu)
    listed.unlink()


def _pipeline(pycolmap: Any, effort: Effort) -> Any:
    """Options: the lens stays, and errors of a rolling shutter are let pass."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = effort.threads, effort.seed
    options.extract_colors = False
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    mapper, triangulation = options.mapper, options.triangulation
    mapper.random_seed = triangulation.random_seed = effort.seed
    mapper.num_threads = effort.threads
    mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = False
    mapper.init_max_error = mapper.filter_max_reproj_error = _MOST_ERROR
    triangulation.merge_max_reproj_error = triangulation.complete_max_reproj_error = _MOST_ERROR
    return options


def _nothing(pycolmap: Any, path: Path, keyframes: int) -> str:
    """Why there is no structure."""
    with pycolmap.Database.open(path) as database:
        _, matches = database.read_two_view_geometry_num_inliers()
        pairs = sum(count >= _LEAST_MATCHES for count in matches)
        features = database.num_keypoints() / keyframes
    return (
        f"no two of the {keyframes} keyframes determine a structure ({features:.0f} features each, "
        f"{pairs} pairs of them agree on {_LEAST_MATCHES} matches or more): the images need "
        "texture that does not repeat, overlap, and a camera that moves sideways and does not "
        "only turn"
    )


def _structure(model: Any, parts: tuple[int, ...]) -> Structure:
    """Arrays of a reconstruction of COLMAP."""
    images = sorted(
        (image for image in model.images.values() if image.has_pose), key=lambda one: str(one.name)
    )
    rows = {image.image_id: int(image.name) for image in images}
    poses = [image.cam_from_world().inverse() for image in images]
    ids = sorted(model.points3D)
    tracks = [
        (point, rows[element.image_id], element.point2D_idx)
        for point, key in enumerate(ids)
        for element in model.points3D[key].track.elements
    ]
    seen = np.array(tracks, np.int64).reshape(-1, 3)
    return Structure(
        views=np.array(list(rows.values()), np.int64),
        rotations=np.array([pose.rotation.matrix() for pose in poses]),
        positions=np.array([pose.translation for pose in poses]),
        points=np.array([model.points3D[key].xyz for key in ids]).reshape(-1, 3),
        seen_points=seen[:, 0],
        seen_views=seen[:, 1],
        seen_features=seen[:, 2],
        parts=parts,
    )
