"""What each command does with many recordings: plans for :mod:`rs_localizer.cli.fleet`.

Workers import the functions ``..._of_many`` by their names; these import the commands.
"""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from rs_localizer.cli import UsageError
from rs_localizer.cli.fleet import Plan, run_fleet
from rs_localizer.config import NodeConfig
from rs_localizer.offline.fleet.task import Figures, Kind

# Of calibrate, in each result.
_SHUTTER = "shutter.yaml"


def replay(args: Namespace, config: NodeConfig) -> None:
    """``replay`` of many recordings."""
    kernels = f"replay {config.solver}{' smooth' if args.smooth else ''}"
    if config.map_file:  # where it is from here, whatever directory a worker is in
        args = Namespace(**vars(args) | {"map": Path(config.map_file)})
    files = _given(args.params, args.map)
    kind = Kind("replay", replay_of_many, kernels, replay_warm)
    run_fleet(args, Plan(kind, lambda _: files, args.overwrite))


def replay_warm(args: Namespace) -> None:
    """Compile what the settings need."""
    from rs_localizer.cli.replay import settings_of
    from rs_localizer.pipeline.frames import FrameLocalizer
    from rs_localizer.trajectory.warm_up import warm_up

    FrameLocalizer(settings_of(args)).warm_up()
    if args.smooth:
        warm_up()


def replay_of_many(args: Namespace, recording: Path, out: Path) -> Figures:
    """One of them: its result in ``out``, and figures for the summary."""
    from rs_localizer.cli.replay import replay_one
    from rs_localizer.cli.replay_summary import figures

    alone = Namespace(**vars(args), overwrite=False)
    return figures(replay_one(alone, recording, out, timed=False))


def detect(args: Namespace) -> None:
    """``detect`` in many recordings."""
    if args.timing:
        raise UsageError("--timing is of one recording: beside others it would tell little")
    files = _given(args.map, args.calibration)
    kind = Kind("detect", detect_of_many, "detect", detect_warm)
    run_fleet(args, Plan(kind, lambda _: files))


def detect_warm(_: Namespace) -> None:
    """Compile what the search needs."""
    from rs_localizer.markers.detection import warm_up

    warm_up()


def detect_of_many(args: Namespace, recording: Path, out: Path) -> Figures:
    """One of them: its result in ``out``, and figures for the summary."""
    from rs_localizer.cli.detect import detect_one

    found = detect_one(Namespace(**vars(args), images=recording, out=out))
    return {
        "images": found.images,
        "with corners": found.with_corners,
        "corners": found.corners,
        "residual of a still pose (px)": found.residual,
        "warnings": "; ".join(found.faults),
    }


def calibrate(args: Namespace) -> None:
    """``calibrate`` with each of many recordings."""
    plots = _name("--plots", args.plots)
    options = ("intrinsics", "imu", "board", "map")
    given = [name for name in options if getattr(args, name) not in (None, False)]
    files = _given(args.map, args.calibration, args.params)
    kind = Kind("calibrate", calibrate_of_many, " ".join(["calibrate", *given]), calibrate_warm)
    run_fleet(Namespace(**vars(args) | {"plots": plots}), Plan(kind, lambda _: files))


def calibrate_warm(_: Namespace) -> None:
    """Compile what images of any kind, and many at once, need."""
    from rs_localizer.markers.detection import warm_up as warm_up_markers
    from rs_localizer.pipeline.frames import FrameLocalizer
    from rs_localizer.trajectory.warm_up import warm_up

    warm_up_markers()
    FrameLocalizer(NodeConfig()).warm_up()
    warm_up()


def calibrate_of_many(args: Namespace, recording: Path, out: Path) -> Figures:
    """One of them: its result in ``out``, and figures for the summary."""
    from rs_localizer.cli.calibrate import calibrate_one
    from rs_localizer.trajectory import verdict

    out.mkdir(parents=True)
    plots = None if args.plots is None else out / args.plots
    own = {"recording": recording, "out": out / _SHUTTER, "plots": plots}
    found = calibrate_one(Namespace(**vars(args) | own))
    return {
        "readout time (ms)": 1e3 * verdict.readout_time(found),
        "deviation (ms)": 1e3 * found.deviation,
        "scan direction": str(verdict.scan_direction(found)),
        "images": found.images,
        "with a pose": len(found.posed.times),
        "noise (px)": float(found.fit.deviation),
    }


def evaluate(args: Namespace) -> None:
    """``evaluate`` of many estimates, each with the truth of its name."""
    if args.twists or args.truth_twists:
        raise UsageError("--twists and --truth-twists are of one recording")
    truths = args.truths.absolute()
    own = {"truths": truths, "plot": _name("--plot", args.plot)}
    kind = Kind("evaluate", evaluate_of_many, "evaluate")
    plan = Plan(kind, lambda estimate: [truth_of(estimate, truths)])
    run_fleet(Namespace(**vars(args) | own), plan)


def evaluate_of_many(args: Namespace, recording: Path, out: Path) -> Figures:
    """One of them: its result in ``out``, and figures for the summary."""
    from rs_localizer.cli.evaluate import evaluate_one, named_errors
    from rs_localizer.evaluation.metrics import summarize

    truth = truth_of(recording, args.truths)
    if not truth.exists():
        raise ValueError(f"there is no truth of {recording}: no {truth}, with or without a suffix")
    out.mkdir(parents=True)
    plot = None if args.plot is None else out / args.plot
    own = {"estimate": recording, "truth": truth, "plot": plot}
    poses, twists = evaluate_one(Namespace(**vars(args) | own))
    figures: Figures = {"poses": len(poses.stamps_ns)}
    for name, errors in named_errors(poses, twists):
        summary = summarize(errors)
        figures |= {f"{name} median": summary.median, f"{name} 95 %": summary.p95}
    return figures


def truth_of(estimate: Path, truths: Path) -> Path:
    """The truth of an estimate: of the same name in another directory, whatever the suffix."""
    name = estimate.name if estimate.is_dir() else estimate.stem
    found = [truths / name] if (truths / name).exists() else sorted(truths.glob(f"{name}.*"))
    return found[0] if len(found) == 1 else truths / name


def _name(option: str, folder: Path | None) -> str | None:
    """The name of a folder that each result gets.

    Raises:
        UsageError: when it is more than a name.
    """
    if folder is None:
        return None
    if len(folder.parts) != 1 or folder.is_absolute() or folder.name in ("", ".."):
        raise UsageError(f"{option} is a name in the folder of each result, got {folder}")
    return folder.name


def _given(*files: Path | str | None) -> list[Path]:
    return [Path(file) for file in files if file]
