# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer evaluate``: errors of estimated poses and twists against the truth."""

from __future__ import annotations

import argparse
from pathlib import Path

from rs_localizer.cli import WORKING, UsageError, number, with_values
from rs_localizer.cli.batch import add_batch_arguments, folder_name, run_batch

if WORKING:
    import numpy as np
    from scipy.spatial.transform import Rotation

    from rs_localizer.evaluation import metrics
    from rs_localizer.evaluation.metrics import Errors, TimeOffset, associate
    from rs_localizer.io.atomic_files import atomic_files
    from rs_localizer.io.bags import BagError, open_bag
    from rs_localizer.io.recording import CORRESPONDENCES_TOPIC, IMAGE_TOPIC, RAW_IMAGE_TOPIC
    from rs_localizer.io.trajectories import Motions, Trajectory, Twists, read_motions, read_twists
    from rs_localizer.offline.fleet.task import Figures, Kind

_AUTO = "auto"
# Deg: less is an error, not another frame. And what is left once a rotation explains the rest.
_ANOTHER_FRAME, _EXPLAINED = 10.0, 0.2
# An offset is worth a warning when errors without it are larger by this factor.
_WORSE = 1.5


def _offset_argument(text: str) -> str | float:
    return text if text == _AUTO else number()(text)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    source = "TUM text, a directory of replay, or a recording"
    parser.add_argument(
        "recordings",
        type=Path,
        nargs="+",
        metavar="EST",
        help=f"{source}; then TRUTH, another one, unless --truths has that of many",
    )
    parser.add_argument(
        "--truths",
        type=Path,
        metavar="DIR",
        help="of many estimates: the directory that holds the truth of each, by the same name",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="of many estimates: directory for the results"
    )
    parser.add_argument("--twists", type=Path, metavar="FILE", help="estimated twists as text")
    parser.add_argument("--truth-twists", type=Path, metavar="FILE", help="true twists as text")
    topics = parser.add_argument_group("topics of recordings (default: the only one of the type)")
    topics.add_argument("--pose-topic", metavar="TOPIC", help="of EST")
    topics.add_argument("--twist-topic", metavar="TOPIC", help="of EST")
    topics.add_argument("--truth-pose-topic", metavar="TOPIC", help="of TRUTH")
    topics.add_argument("--truth-twist-topic", metavar="TOPIC", help="of TRUTH")
    parser.add_argument(
        "--tolerance",
        type=number(0.0),
        default=1e-3,
        metavar="S",
        help="largest difference of times that are compared (default: %(default)s)",
    )
    parser.add_argument(
        "--offset",
        type=_offset_argument,
        metavar=f"S|{_AUTO}",
        help="add this to the times of EST, and interpolate TRUTH; "
        f"{_AUTO}: the offset between the clocks, which is printed in any case",
    )
    parser.add_argument(
        "--ate",
        action="store_true",
        help="also ATE and RPE, after alignment by positions and orientations (needs evo)",
    )
    parser.add_argument(
        "--plot",
        type=Path,
        metavar="DIR",
        help="draw trajectories and errors; of many estimates, its name in the folder of each",
    )
    add_batch_arguments(parser)


def run(args: argparse.Namespace) -> Figures | None:
    if args.truths is not None:
        _evaluate_batch(args)
        return None
    if len(args.recordings) != 2:
        raise UsageError("give EST and TRUTH, or estimates and --truths DIR")
    if args.out is not None or args.workers is not None or args.scheduler is not None:
        raise UsageError("--out, --workers and --scheduler go with --truths")
    estimate, truth = args.recordings
    return evaluate_one(with_values(args, estimate=estimate, truth=truth))


def evaluate_one(args: argparse.Namespace) -> Figures:
    """Compare one estimate with its truth; print and draw it, and give its figures."""
    estimate = read_motions(args.estimate, args.pose_topic, args.twist_topic)
    truth = read_motions(args.truth, args.truth_pose_topic, args.truth_twist_topic)
    if args.twists is not None:
        estimate = Motions(estimate.poses, read_twists(args.twists))
    if args.truth_twists is not None:
        truth = Motions(truth.poses, read_twists(args.truth_twists))
    offset = metrics.estimate_offset(estimate.poses, truth.poses)
    tolerance_ns = round(args.tolerance * 1e9)
    whole = len(estimate.poses)
    if args.offset is not None:
        seconds = _offset(args.offset, offset)
        estimate, truth = _moved(estimate, truth, seconds)
        tolerance_ns = 0
        print(f"{seconds:+.4f} s are added to the times of {args.estimate}")
    poses = metrics.pose_errors(estimate.poses, truth.poses, tolerance_ns)
    if len(poses.stamps_ns) == 0:
        raise ValueError(
            f"no pose of {args.estimate} is within {args.tolerance:g} s of one of {args.truth}: "
            f"{_span(estimate.poses)} against {_span(truth.poses)}{_hint(offset)}"
        )
    errors = [("position (m)", poses.linear), ("orientation (deg)", poses.angular)]
    twists = None
    if estimate.twists is not None and truth.twists is not None:
        twists = metrics.twist_errors(estimate.twists, truth.twists, tolerance_ns)
        errors.append(("angular velocity (deg/s)", twists.angular))
        errors.append(("linear velocity (m/s)", twists.linear))
    print(f"{len(poses.stamps_ns)} of {whole} poses compared")
    if args.offset is None:
        print(_coverage(args.truth, estimate.poses, truth.poses, tolerance_ns))
        _print_offset(offset)
    if text := _other_frames(estimate.poses, truth.poses, tolerance_ns):
        print(f"warning: {text}")
    print()
    print(f"{'error':26}{'count':>8}{'median':>11}{'mean':>11}{'95 %':>11}{'largest':>11}")
    figures: Figures = {"poses": len(poses.stamps_ns)}
    for name, values in errors:
        of = metrics.summarize(values)
        columns = "".join(f"{each:11.5f}" for each in (of.median, of.mean, of.p95, of.maximum))
        print(f"{name:26}{of.count:8}{columns}")
        figures |= {f"{name} median": of.median, f"{name} 95 %": of.p95}
    if args.ate:
        _print_ate(estimate.poses, truth.poses, tolerance_ns)
    if args.plot is not None:
        _plot(args.plot, estimate.poses, truth.poses, poses, twists)
    return figures


def _offset(given: str | float, estimated: TimeOffset | None) -> float:
    if not isinstance(given, str):
        return given
    if estimated is None:
        raise ValueError(
            "the motion does not determine a time offset: too short, too little turning, or not "
            "the same motion; give it with --offset SECONDS"
        )
    return estimated.seconds


def _moved(estimate: Motions, truth: Motions, seconds: float) -> tuple[Motions, Motions]:
    """The estimate at other times, and the truth at just these."""
    poses = metrics.shifted(estimate.poses, seconds)
    inside, true = metrics.interpolated(truth.poses, poses.stamps_ns)
    twists, true_twists = estimate.twists, truth.twists
    if twists is not None and true_twists is not None:
        stamps = twists.stamps_ns + round(seconds * 1e9)
        twists = Twists(stamps, twists.angular, twists.linear)
        true_twists = metrics.interpolated_twists(true_twists, stamps)
    return Motions(poses.part(inside), twists), Motions(true, true_twists)


def _hint(offset: TimeOffset | None) -> str:
    if offset is None:
        return ""
    return (
        f"; the motions agree when {offset.seconds:+.4f} s are added to its times: --offset {_AUTO}"
    )


def _print_offset(offset: TimeOffset | None) -> None:
    """What the time offset is; a warning where it matters."""
    if offset is None:
        print("time offset: not determined by this motion")
        return
    before, after = offset.before, offset.after
    print(
        f"time offset: {round(offset.seconds, 4) + 0.0:+.4f} s to be added (angular speeds "
        f"correlate by {offset.correlation:.3f})"
    )
    if not before < _WORSE * after:  # NaN compares false
        print(
            f"warning: with this offset the median orientation error is {after:.3f} deg, without "
            f"it {before:.3f} deg: the clocks differ; apply it with --offset {_AUTO}"
        )


def _other_frames(estimate: Trajectory, truth: Trajectory, tolerance_ns: int) -> str:
    """What to say of orientations that all differ by one rotation; empty: nothing."""
    rows, true_rows = associate(estimate.stamps_ns, truth.stamps_ns, tolerance_ns)
    if len(rows) < 2:
        return ""
    estimated = Rotation.from_quat(estimate.quaternions[rows])
    true = Rotation.from_quat(truth.quaternions[true_rows])
    before = float(np.degrees(np.median((true.inv() * estimated).magnitude())))
    for whose, between in (
        ("body (base_frame, optical axes)", true.inv() * estimated),
        ("map", estimated * true.inv()),
    ):
        turn = between.mean()
        after = float(np.degrees(np.median((turn.inv() * between).magnitude())))
        if before > _ANOTHER_FRAME and after < _EXPLAINED * before:
            angle = float(np.degrees(turn.magnitude()))
            axis = turn.as_rotvec() / turn.magnitude()
            x, y, z, w = turn.as_quat(canonical=True)
            return (
                f"the poses are given in different frames of the {whose}: a turn of {angle:.2f} "
                f"deg about ({axis[0]:.3f}, {axis[1]:.3f}, {axis[2]:.3f}) (quaternion x y z w "
                f"{x:.4f} {y:.4f} {z:.4f} {w:.4f}) explains all but {after:.3f} deg of "
                f"{before:.3f} deg"
            )
    return ""


def _plot(
    directory: Path, estimate: Trajectory, truth: Trajectory, poses: Errors, twists: Errors | None
) -> None:
    from rs_localizer.evaluation import plots  # half a second

    directory.mkdir(parents=True, exist_ok=True)
    drawn = (
        plots.trajectories(truth, {"estimate": estimate}),
        plots.errors({"estimate": poses}, {"estimate": twists} if twists else {}),
    )
    for name, figure in zip(("trajectories.png", "errors.png"), drawn, strict=True):
        with atomic_files(directory / name) as (part,):
            plots.save(figure, part)
        print(f"{directory / name}")


def _coverage(path: Path, estimate: Trajectory, truth: Trajectory, tolerance_ns: int) -> str:
    """How much of what the truth knows has been localized."""
    rows, true_rows = associate(estimate.stamps_ns, truth.stamps_ns, tolerance_ns)
    try:
        with open_bag(path) as bag:
            topics = (CORRESPONDENCES_TOPIC, IMAGE_TOPIC, RAW_IMAGE_TOPIC)
            of_frames = next((topic for topic in topics if topic in bag.topics), None)
            frames = bag.count({of_frames}) if of_frames else 0
    except BagError:  # a text file, or a directory of them
        frames = 0
    if frames > 0:  # their truth may stand there for several instants of each
        return f"{len(rows)} of {frames} frames have a pose"
    return f"{len(set(true_rows.tolist()))} of {len(truth)} true poses have an estimate"


def _print_ate(estimate: Trajectory, truth: Trajectory, tolerance_ns: int) -> None:
    try:
        from evo.core import metrics as evo
        from evo.core import trajectory
    except ImportError as error:
        raise ValueError(
            "--ate needs the package evo, which is not installed: pip install evo"
        ) from error
    rows, true_rows = associate(estimate.stamps_ns, truth.stamps_ns, tolerance_ns)
    true_part, part = truth.part(true_rows), estimate.part(rows)
    true, estimated = (
        trajectory.PoseTrajectory3D(
            poses.positions,
            np.roll(poses.quaternions, 1, axis=1),  # evo puts w first
            (poses.stamps_ns - part.stamps_ns[0]) * 1e-9,
        )
        for poses in (true_part, metrics.aligned(part, true_part))
    )
    parts = evo.PoseRelation
    for name, metric in (
        ("ATE (m rms)", evo.APE(parts.translation_part)),
        ("ATE (deg rms)", evo.APE(parts.rotation_angle_deg)),
        ("RPE, next frame (m rms)", evo.RPE(parts.translation_part)),
        ("RPE, next frame (deg rms)", evo.RPE(parts.rotation_angle_deg)),
    ):
        metric.process_data((true, estimated))
        print(f"{name:34}{metric.get_statistic(evo.StatisticsType.rmse):11.5f}")


def _span(poses: Trajectory) -> str:
    first, last = poses.stamps_ns[[0, -1]] * 1e-9
    return f"{first:.3f} to {last:.3f} s"


def _evaluate_batch(args: argparse.Namespace) -> None:
    """``evaluate`` of many estimates, each with the truth of its name."""
    if args.twists or args.truth_twists:
        raise UsageError("--twists and --truth-twists are of one recording")
    truths, kind = args.truths.absolute(), Kind("evaluate", _evaluate_of_many, "evaluate")
    own = with_values(args, truths=truths, plot=folder_name("--plot", args.plot))
    run_batch(own, kind, lambda estimate: [_truth_of(estimate, truths)])


def _evaluate_of_many(args: argparse.Namespace, recording: Path, out: Path) -> Figures:
    truth = _truth_of(recording, args.truths)
    if not truth.exists():
        raise ValueError(f"there is no truth of {recording}: no {truth}, with or without a suffix")
    out.mkdir(parents=True)
    plot = None if args.plot is None else out / args.plot
    return evaluate_one(with_values(args, estimate=recording, truth=truth, plot=plot))


def _truth_of(estimate: Path, truths: Path) -> Path:
    """The truth of an estimate: of the same name in another directory, whatever the suffix."""
    name = estimate.name if estimate.is_dir() else estimate.stem
    files = [truths / name] if (truths / name).exists() else sorted(truths.glob(f"{name}.*"))
    return files[0] if len(files) == 1 else truths / name
