# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer evaluate``: errors of estimated poses and twists against the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rs_localizer.cli import WORKING
from rs_localizer.cli.options import UsageError, argument, option
from rs_localizer.io.bags import BagError, open_bag
from rs_localizer.io.recording import CORRESPONDENCES_TOPIC, IMAGE_TOPIC, RAW_IMAGE_TOPIC

if WORKING:
    import numpy as np
    from scipy.spatial.transform import Rotation

    from rs_localizer.io.atomic_files import atomic_files
    from rs_localizer.io.trajectories import Motions, Trajectory, Twists, read_motions, read_twists
    from rs_localizer.offline.fleet import Figures
    from rs_localizer.tools.evaluation import metrics
    from rs_localizer.tools.evaluation.metrics import associate

_TOPICS = ("pose", "twist", "truth_pose", "truth_twist")
# Deg: less is an error, not another frame. And what is left once a rotation explains the rest.
_ANOTHER_FRAME, _EXPLAINED = 10.0, 0.2
# Largest difference of times that are compared: rounding, where both are of one image.
_TOLERANCE_NS = 1_000_000


@dataclass(frozen=True, kw_only=True)
class Options:
    estimate: Path = argument("TUM text, a directory of replay, or a recording", "EST")
    truth: Path = argument("likewise", "TRUTH")
    truth_twists: Path | None = option("true twists as text", "FILE")
    remaps: list[str] = option(
        f"a topic of recordings, NAME one of {', '.join(_TOPICS)}; may be repeated (default: the "
        "only one of its type)", "NAME:=TOPIC", list, flag="-r",
    )  # fmt: skip
    offset: float = option("add this to the times of EST, s", "S", 0.0)
    ate: bool = option(
        "also ATE and RPE after alignment, by evo (pip install 'rs_localizer[evo]')", default=False
    )
    plot: Path | None = option("draw the errors over time", "FILE.png")


def run(options: Options) -> Figures:
    topics = _topics(options)
    estimate = read_motions(options.estimate, topics.get("pose"), topics.get("twist"))
    truth = read_motions(options.truth, topics.get("truth_pose"), topics.get("truth_twist"))
    if options.truth_twists is not None:
        truth = Motions(truth.poses, read_twists(options.truth_twists))
    estimate = _moved(estimate, round(options.offset * 1e9))
    tolerance_ns = _TOLERANCE_NS
    poses = metrics.pose_errors(estimate.poses, truth.poses, tolerance_ns)
    if len(poses.stamps_ns) == 0:
        raise ValueError(
            f"no pose of {options.estimate} is within {1e-9 * _TOLERANCE_NS:g} s of one of "
            f"{options.truth}: {_span(estimate.poses)} against {_span(truth.poses)}"
        )
    rows = [("position", "m", poses.linear), ("orientation", "deg", poses.angular)]
    if estimate.twists is not None and truth.twists is not None:
        twists = metrics.twist_errors(estimate.twists, truth.twists, tolerance_ns)
        rows.append(("angular velocity", "deg/s", twists.angular))
        rows.append(("linear velocity", "m/s", twists.linear))
    print(f"{len(poses.stamps_ns)} of {len(estimate.poses)} poses compared")
    print(_coverage(options.truth, estimate.poses, truth.poses, tolerance_ns))
    if text := _other_frames(estimate.poses, truth.poses, tolerance_ns):
        print(f"warning: {text}")
    print(f"\n{'error':26}{'count':>8}{'median':>11}{'mean':>11}{'95 %':>11}{'largest':>11}")
    figures: Figures = {"poses": len(poses.stamps_ns)}
    for name, unit, values in rows:
        of = metrics.summarize(values)
        columns = "".join(f"{each:11.5f}" for each in (of.median, of.mean, of.p95, of.maximum))
        print(f"{f'{name} ({unit})':26}{of.count:8}{columns}")
        known, suffix = name.replace(" ", "_"), unit.replace("/", "_per_")
        figures |= {f"{known}_median_{suffix}": of.median, f"{known}_p95_{suffix}": of.p95}
    if options.ate:
        figures |= _by_evo(estimate.poses, truth.poses, tolerance_ns)
    if options.plot is not None:
        from rs_localizer.tools.evaluation import plots  # half a second

        of_twists = {"estimate": twists} if len(rows) > 2 else {}
        options.plot.parent.mkdir(parents=True, exist_ok=True)
        with atomic_files(options.plot) as (part,):
            plots.save(plots.errors({"estimate": poses}, of_twists), part)
        print(f"written: {options.plot}")
    return figures


def _topics(options: Options) -> Mapping[str, str]:
    pairs = [text.partition(":=") for text in options.remaps]
    for name, _, topic in pairs:
        if name not in _TOPICS or not topic:
            raise UsageError(f"-r: expected NAME:=TOPIC of {', '.join(_TOPICS)}; got {name!r}")
    return {name: topic for name, _, topic in pairs}


def _moved(motions: Motions, offset_ns: int) -> Motions:
    """The same at other times."""
    poses, twists = motions.poses, motions.twists
    poses = Trajectory(poses.stamps_ns + offset_ns, poses.positions, poses.quaternions)
    if twists is not None:
        twists = Twists(twists.stamps_ns + offset_ns, twists.angular, twists.linear)
    return Motions(poses, twists)


def _other_frames(estimate: Trajectory, truth: Trajectory, tolerance_ns: int) -> str:
    """What to say of orientations that all differ by one rotation; empty: nothing."""
    rows, true_rows = associate(estimate.stamps_ns, truth.stamps_ns, tolerance_ns)
    if len(rows) < 2:
        return ""
    estimated = Rotation.from_quat(estimate.quaternions[rows])
    true = Rotation.from_quat(truth.quaternions[true_rows])
    before = float(np.degrees(np.median((true.inv() * estimated).magnitude())))
    shifted = Rotation.from_quat(truth.quaternions[true_rows][:, [1, 2, 3, 0]])
    after = float(np.degrees(np.median((shifted.inv() * estimated).magnitude())))
    if before > _ANOTHER_FRAME and after < _EXPLAINED * before:
        return (
            f"are quaternions of TRUTH given w first? Read so, orientations differ by {after:.3f} "
            f"deg and not {before:.3f} (TUM's lines are t x y z qx qy qz qw)"
        )
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


def _by_evo(estimate: Trajectory, truth: Trajectory, tolerance_ns: int) -> Figures:
    """ATE and RPE, printed, after Umeyama's alignment of the positions."""
    try:
        from evo.core import metrics as evo
        from evo.core import trajectory
    except ImportError as error:
        raise ValueError("--ate needs evo: pip install 'rs_localizer[evo]'") from error
    rows, true_rows = associate(estimate.stamps_ns, truth.stamps_ns, tolerance_ns)
    true, estimated = (
        trajectory.PoseTrajectory3D(
            part.positions,
            np.roll(part.quaternions, 1, axis=1),  # evo puts w first
            (part.stamps_ns - estimate.stamps_ns[0]) * 1e-9,
        )
        for part in (truth.part(true_rows), estimate.part(rows))
    )
    estimated.align(true)
    parts, figures = evo.PoseRelation, Figures()
    for name, key, metric in (
        ("ATE (m rms)", "ate_m", evo.APE(parts.translation_part)),
        ("ATE (deg rms)", "ate_deg", evo.APE(parts.rotation_angle_deg)),
        ("RPE, next frame (m rms)", "rpe_m", evo.RPE(parts.translation_part)),
        ("RPE, next frame (deg rms)", "rpe_deg", evo.RPE(parts.rotation_angle_deg)),
    ):
        metric.process_data((true, estimated))
        figures[key] = float(metric.get_statistic(evo.StatisticsType.rmse))
        print(f"{name:34}{figures[key]:11.5f}")
    return figures


def _span(poses: Trajectory) -> str:
    first, last = poses.stamps_ns[[0, -1]] * 1e-9
    return f"{first:.3f} to {last:.3f} s"
