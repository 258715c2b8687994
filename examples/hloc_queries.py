# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses and velocities of what hloc has matched, in place of hloc's ``localize_sfm``.

    python examples/hloc_queries.py sfm queries.txt pairs.txt features.h5 matches.h5 poses.txt 0.03

Takes a sparse model of COLMAP in metres, hloc's list of queries with intrinsics, its pairs,
features and matches, and the readout time in s. Writes hloc's own result file,
``NAME QW QX QY QZ TX TY TZ`` (camera_from_map at the middle row), and ``poses_motion.json``.
"""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from script import one_line, run

import rs_localizer as rsl

with one_line():
    import h5py
    import pycolmap

# COLMAP's models: names of their coefficients here.
LENSES = {
    "SIMPLE_PINHOLE": ("plumb_bob", 0), "PINHOLE": ("plumb_bob", 0),
    "SIMPLE_RADIAL": ("plumb_bob", 1), "RADIAL": ("plumb_bob", 2), "OPENCV": ("plumb_bob", 4),
    "FULL_OPENCV": ("rational_polynomial", 8), "OPENCV_FISHEYE": ("equidistant", 4),
}  # fmt: skip


def camera_of(words: list[str], readout_time: float) -> rsl.Camera:
    """The camera of MODEL WIDTH HEIGHT PARAMETERS."""
    if words[0] not in LENSES:
        raise ValueError(f"the model must be one of {', '.join(LENSES)}, found {words[0]}")
    lens, count = LENSES[words[0]]
    width, height, *params = map(float, words[1:])
    of = pycolmap.Camera(model=words[0], width=int(width), height=int(height), params=params)
    K = of.calibration_matrix()
    K[:2, 2] -= 0.5  # COLMAP has the corner of the first pixel at 0, 0, we its centre
    D = np.zeros(8 if lens == "rational_polynomial" else 4)
    if count:
        D[:count] = params[-count:]
    return rsl.Camera(int(width), int(height), K, D, lens, readout_time=readout_time)


def matches_of(file: Any, query: str, image: str) -> np.ndarray:
    """Keypoints (m,2) of the query and of the image that are matched."""
    one, other = (name.replace("/", "-") for name in (query, image))
    for separator in ("/", "_"):  # as hloc writes now, and as it did
        for first, second, turned in ((one, other, False), (other, one, True)):
            if (key := f"{first}{separator}{second}") in file:
                found = file[key]["matches0"][()].astype(int)
                rows = np.flatnonzero(found >= 0)
                pairs = np.column_stack([rows, found[rows]])
                return pairs[:, ::-1] if turned else pairs
    raise ValueError(f"there are no matches of {query} and {image}: made with other pairs?")


def localize(
    model: Any, images: list[Any], query: str, camera: rsl.Camera, features: Any, matches: Any
) -> tuple[rsl.Estimate | rsl.Failure, int]:
    """One query by all its matches with points of the model, and how many these are."""
    keypoints = features[query]["keypoints"][()][:, :2].astype(float)
    votes: Counter[tuple[int, int]] = Counter()  # keypoint and point, by how many images say so
    for image in images:
        points2D = image.points2D
        for keypoint, feature in matches_of(matches, query, image.name).tolist():
            if feature >= len(points2D) or keypoint >= len(keypoints):
                raise ValueError(f"matches of {query} and {image.name}: other features or model?")
            if points2D[feature].has_point3D():
                votes[keypoint, points2D[feature].point3D_id] += 1
    pairs = sorted(votes)
    points = np.array([model.points3D[point].xyz for _, point in pairs]).reshape(-1, 3)
    pixels = keypoints[[keypoint for keypoint, _ in pairs]].reshape(-1, 2)
    scores = np.array([votes[pair] for pair in pairs], float)
    return rsl.Localizer(camera).localize(points, pixels, scores), len(pairs)


def main(sfm: str, queries: str, retrieval: str, features: str, matches: str, results: str,
         readout_time: str) -> None:  # fmt: skip
    """Localize all queries and write the results."""
    model = pycolmap.Reconstruction(sfm)
    known = {image.name: image for image in model.images.values()}
    paired: dict[str, list[Any]] = {}
    for query, image in map(str.split, Path(retrieval).read_text().splitlines()):
        paired.setdefault(query, []).extend([known[image]] if image in known else [])
    lines, motions = [], {}
    with h5py.File(features) as of_features, h5py.File(matches) as of_matches:
        for name, *words in map(str.split, Path(queries).read_text().splitlines()):
            camera, images = camera_of(words, float(readout_time)), paired.get(name, [])
            result, count = localize(model, images, name, camera, of_features, of_matches)
            if not result:
                print(f"{name}: {result}")
                continue
            state = rsl.camera_state(result, camera)
            x, y, z, w = state.orientation * [-1.0, -1.0, -1.0, 1.0]  # camera_from_map
            pose = [w, x, y, z, *result.translation]
            lines.append(" ".join([name.rpartition("/")[2], *(repr(float(v)) for v in pose)]))
            motions[name] = {
                "matches": count,
                "inliers": int(result.inliers.sum()),
                "angular_velocity_rad_per_s": state.angular_velocity.tolist(),
                "linear_velocity_m_per_s": state.linear_velocity.tolist(),
                "twist_deviations": (  # angular, then linear
                    np.sqrt(np.diag(result.covariance)[6:]) / float(readout_time)
                ).tolist(),
            }
    if not lines:
        raise ValueError("no query was localized")
    Path(results).write_text("\n".join(lines) + "\n")
    beside = Path(results).with_name(f"{Path(results).stem}_motion.json")
    beside.write_text(json.dumps({"camera_axes": True, "queries": motions}, indent=1))
    print(f"{results}, {beside.name}: {len(lines)} queries localized")


if __name__ == "__main__":
    run(main, "SFM QUERIES PAIRS FEATURES.h5 MATCHES.h5 POSES READOUT_TIME    (files of hloc; s)")
