# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map survey``: where markers are, from a recording that shows them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from rs_localizer.cli import refuse_existing, write_all
from rs_localizer.cli.options import ResultOptions, UsageError, argument, option
from rs_localizer.cli.recording_input import ImageOptions, each_image, given_settings
from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.families import FAMILIES, LEAST_SIDE, Family, family
from rs_localizer.markers.map_files import write_marker_map
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Marker, Pose
from rs_localizer.tools.mapping.survey import MISFIT, Survey, survey
from rs_localizer.tools.mapping.unknown_markers import Filmed, Spotted


@dataclass(frozen=True, kw_only=True)
class Options(ImageOptions, ResultOptions):
    recording: Path = argument("a video, a folder of images, or a bag", "RECORDING")
    family: list[str] = option(
        f"of the markers; may be repeated: {', '.join(FAMILIES)}", "NAME", list, required=True
    )
    size: list[str] = option(
        "side of the black square, m: of all markers, and, repeated, of ids that differ",
        "[ID[-ID]:]M", list, required=True,
    )  # fmt: skip
    origin: int | None = option(
        "marker whose frame is that of the map (default: the lowest id of the largest connected "
        "group)", "ID",
    )  # fmt: skip
    out: Path = option("map to write", "WALL.yaml", required=True)


def run(args: Options) -> None:
    if args.out.suffix not in (".yaml", ".yml"):
        raise UsageError(f"--out must end in .yaml, got {args.out}")
    config, markers = given_settings(args), _markers(args)
    origin = next((k for k, marker in enumerate(markers) if marker.id == args.origin), None)
    if args.origin is not None and origin is None:
        raise UsageError(f"--origin: {' and '.join(args.family)} have no id {args.origin}")
    refuse_existing(args)
    filmed = _filmed(args, config, MarkerDetector(MarkerMap(markers), LEAST_SIDE))
    found = survey(filmed, markers, origin=origin)
    _print_result(found, len(filmed.spotted))
    if found.shutter.readout_check is not None:
        found.shutter.readout_check.refuse()
    pairs = zip(found.markers, found.deviations_of_shape, strict=True)
    marker_map = MarkerMap(tuple(replace(one, deviations=spread) for one, spread in pairs))
    write_all({args.out: partial(write_marker_map, marker_map=marker_map)})


def _markers(args: Options) -> tuple[Marker, ...]:
    try:
        families: list[Family] = [family(name) for name in args.family]
    except ValueError as error:
        raise UsageError(f"--family: {error}") from error
    kinds = [one.kind for one in families]
    if len(set(kinds)) < len(kinds):
        raise UsageError("--family: families of one kind share their patterns; give the largest")
    size, sizes = 0.0, dict[int, float]()
    for text in args.size:
        ids, _, metres = text.rpartition(":")
        try:
            value = float(metres)
            if not 0.0 < value < np.inf:
                raise ValueError
            if ids:
                first, _, last = ids.partition("-")
                sizes |= dict.fromkeys(range(int(first), int(last or first) + 1), value)
            else:
                size = value
        except ValueError:
            raise UsageError(f"--size must be metres, or ID[-ID]:metres, got {text!r}") from None
    if not size:
        raise UsageError("--size needs the size of all other markers, too")
    every = [(of.name, id_) for of in families for id_ in range(of.count)]
    return tuple(Marker.at(name, id_, sizes.get(id_, size), Pose()) for name, id_ in every)


def _filmed(args: Options, config: NodeConfig, detector: MarkerDetector) -> Filmed:
    """Return the camera and the markers of each image."""
    spotted = dict[int, Spotted]()
    camera: Camera | None = None
    for image, own in each_image(args, config.scan_direction):
        if camera is not None and own is not camera:
            raise ValueError("camera_info changes within the recording; cut it there")
        camera, stamp = own, image.stamp_ns
        spotted[stamp] = Spotted.of(detector.detect(image.pixels, stamp), stamp)
    if camera is None:
        raise ValueError(f"{args.recording} has no image that can be read")
    every = [spotted[stamp] for stamp in sorted(spotted)]
    camera = replace(camera, readout_time=config.readout_time)
    return Filmed(camera, every, config.stamp_offset)


def _print_result(found: Survey, images: int) -> None:
    """Print the table of the markers, with their deviations."""
    fit, shutter = found.fit, found.shutter
    print(f"noise of the corners     {fit.deviation:.3f} px, {np.mean(fit.inliers):.1%} fit")
    print(f"{'images with a marker':24} {found.images} of {images}")
    deviation = shutter.readout_time_deviation
    spread = "" if np.isnan(deviation) else f" +- {1e3 * deviation:.3f}"
    print(f"{'readout time':24} {1e3 * shutter.readout_time:.3f}{spread} ms")
    print(
        f"{'marker':26} {'images':>6} {'x':>9} {'y':>9} {'z (m)':>9} {'+- (mm)':>8} {'+- (deg)':>8}"
    )
    for marker, sights, deviations, poor in zip(
        found.markers, found.sights, found.deviations_of_shape, found.poor, strict=True
    ):
        x, y, z = marker.pose.position
        place, turn = np.linalg.norm(deviations.reshape(2, 3), axis=1) * [1e3, np.degrees(1.0)]
        name, mark = marker.name.removeprefix("marker "), " poor" if poor else ""
        print(f"{name:26} {sights:6} {x:9.4f} {y:9.4f} {z:9.4f} {place:8.2f} {turn:8.3f}{mark}")
    if found.poor.any():
        poor = tuple(found.markers[k] for k in np.flatnonzero(found.poor))
        print(f"warning: known to worse than a tenth of their size: {_listed(poor)}")
    for part in found.apart:
        print(
            f"not connected: {_listed(part)}: no image shows one of them together with those above"
        )
    if found.misfits:
        print(f"left out: {_listed(found.misfits)}: corners do not fit the others: {MISFIT}")
    if found.rare:
        print(
            f"left out: {_listed(found.rare)}: too few images show them, or not enough to "
            "determine their orientation"
        )


def _listed(markers: tuple[Marker, ...]) -> str:
    return ", ".join(marker.name for marker in markers)
