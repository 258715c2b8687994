# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer localize-hloc``: what hloc has matched -> poses and velocities."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

from rs_localizer.cli import WORKING, add_overwrite
from rs_localizer.cli.settings_args import add_settings, given_settings, row_time

if WORKING:
    from tqdm import tqdm

    from rs_localizer.config import NodeConfig
    from rs_localizer.core import so3
    from rs_localizer.core.types import Estimate
    from rs_localizer.io.atomic_files import OutputError, atomic_files
    from rs_localizer.offline import hloc
    from rs_localizer.offline.hloc import Answer
    from rs_localizer.pipeline.pose_at_time import pose_at, twist_at
    from rs_localizer.solvers.table import find_solver

_ABOUT = {
    "angular_velocity": "rad/s, of the camera in its own axes",
    "linear_velocity": "m/s, of the camera's centre in its own axes",
    "pose_covariance": "6x6: position (m), then rotation (rad) about the axes of the map",
    "twist_covariance": "6x6: linear, then angular velocity",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    files = parser.add_argument_group("files of hloc, as its localize_sfm takes them")
    for name, metavar, text in (
        ("reference-sfm", "DIR", "sparse model of COLMAP: points3D and images, .bin or .txt"),
        ("queries", "FILE", "NAME MODEL WIDTH HEIGHT PARAMETERS a line"),
        ("retrieval", "FILE", "pairs: QUERY IMAGE a line"),
        ("features", "FILE", "features .h5 of the queries"),
        ("matches", "FILE", "matches .h5 of the pairs"),
        ("results", "FILE", "to write: NAME QW QX QY QZ TX TY TZ, and MOTION beside it"),
    ):
        files.add_argument(f"--{name}", type=Path, required=True, metavar=metavar, help=text)
    files.add_argument(
        "--prepend-camera-name",
        action="store_true",
        help="keep the last folder of a query's name in the results",
    )
    parser.add_argument(
        "--row",
        type=row_time,
        default=0.0,
        metavar="ROW",
        help="whose pose is written: first, middle, last, or a row time from -0.5 to 0.5 "
        "(default: middle)",
    )
    add_overwrite(parser)
    add_settings(parser.add_argument_group("settings, as of replay; readout_time among them"))


def run(args: argparse.Namespace) -> None:
    config = given_settings(args)
    motion = args.results.with_name(f"{args.results.stem}_motion.json")
    for path in (args.results, motion):
        if path.exists() and not args.overwrite:
            raise OutputError(f"{path} exists already; it is replaced with --overwrite")
    reference = hloc.Reference(args.reference_sfm)
    queries, pairs = hloc.read_queries(args.queries), hloc.read_pairs(args.retrieval)
    paired = {image for images in pairs.values() for image in images}
    unknown = sorted(paired - reference.images.keys())
    if len(unknown) == len(paired):
        raise hloc.HlocError(
            f"no image of {args.retrieval} is in the model: {unknown[0]} is not one of "
            f"{', '.join(sorted(reference.images)[:3])} ..."
        )
    with hloc.open_h5(args.features) as features, hloc.open_h5(args.matches) as matches:
        answers = hloc.localize_queries(reference, queries, pairs, features, matches, config)
        bar = tqdm(answers, total=len(queries), unit="image", desc="localize", disable=None)
        localized = list(bar)
    if not any(isinstance(answer.result, Estimate) for answer in localized):
        raise ValueError(f"none of {len(localized)} queries was localized; {_why(localized)}")
    with atomic_files(args.results, motion) as (results_part, motion_part):
        results_part.write_text("".join(_lines(localized, args)), encoding="utf-8")
        motion_part.write_text(
            json.dumps(_motions(localized, args, config), indent=1), encoding="utf-8"
        )
    if unknown:
        print(f"{len(unknown)} paired images are not in the model, the first one: {unknown[0]}")
    _tell(localized, args.results, motion, config)


def _lines(answers: list[Answer], args: argparse.Namespace) -> list[str]:
    lines = []
    for answer in answers:
        if isinstance(answer.result, Estimate):
            rotation, translation = answer.result.at(args.row)
            name = hloc.result_name(answer.name, args.prepend_camera_name)
            lines.append(f"{hloc.result_line(name, so3.quaternion(rotation), translation)}\n")
    return lines


def _motions(answers: list[Answer], args: argparse.Namespace, config: NodeConfig) -> dict[str, Any]:
    """Velocities and covariances by the query's full name; of an unknown motion, None."""
    moving = config.readout_time > 0.0 and find_solver(config.solver).rolling_shutter
    queries = {}
    for answer in answers:
        estimate = answer.result
        if not isinstance(estimate, Estimate):
            continue
        twist = twist_at(estimate, args.row, config.readout_time) if moving else None
        queries[answer.name] = {
            "matches": answer.matches,
            "inliers": int(estimate.inliers.sum()),
            "angular_velocity": None if twist is None else twist.angular.tolist(),
            "linear_velocity": None if twist is None else twist.linear.tolist(),
            "pose_covariance": pose_at(estimate, args.row).covariance.tolist(),
            "twist_covariance": None if twist is None else twist.covariance.tolist(),
        }
    return {"about": _ABOUT, "row_time": args.row, "queries": queries}


def _why(answers: list[Answer]) -> str:
    reasons = Counter(
        answer.result if isinstance(answer.result, str) else str(answer.result)
        for answer in answers
        if not isinstance(answer.result, Estimate)
    )
    (text, _), *_ = reasons.most_common(1)
    return f"most often: {text}"


def _tell(answers: list[Answer], results: Path, motion: Path, config: NodeConfig) -> None:
    localized = [answer for answer in answers if isinstance(answer.result, Estimate)]
    print(f"{results}, {motion.name}: {len(localized)} of {len(answers)} queries localized")
    if len(localized) < len(answers):
        print(f"without a pose {len(answers) - len(localized)}; {_why(answers)}")
    if config.readout_time == 0.0:
        print("no velocities: readout_time is 0 (unknown); give it with -p readout_time:=SECONDS")
