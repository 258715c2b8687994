"""``rs_localizer map align``: scale, direction of gravity and origin of a map."""

from __future__ import annotations

import argparse

import numpy as np

from rs_localizer.cli import UsageError
from rs_localizer.cli.map import either
from rs_localizer.core.arrays import Array
from rs_localizer.mapping.aligning import Wishes, alignment, moved, moved_markers
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.process.arguments import number


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Bring a map to metres, to z up and to an origin; what is not given stays as it is. IDs "
        "are those of landmarks, or of markers, whose middles count."
    )
    either.add_input(parser)
    either.add_output(parser)
    size = parser.add_argument_group("size").add_mutually_exclusive_group()
    size.add_argument("--scale", type=number(0.0, above=True), metavar="FACTOR")
    size.add_argument(
        "--distance", nargs=3, metavar=("ID", "ID", "M"), help="two ids and how far apart they are"
    )
    level = parser.add_argument_group("gravity: z of the new map")
    level = level.add_mutually_exclusive_group()
    level.add_argument(
        "--up",
        nargs=3,
        type=number(),
        metavar=("X", "Y", "Z"),
        help="direction in the map as it is",
    )
    level.add_argument(
        "--floor", nargs="+", type=int, metavar="ID", help="three or more in a level plane, at the "
        "bottom of the map"
    )  # fmt: skip
    level.add_argument(
        "--upright", type=int, metavar="ID", help="marker that hangs upright: its y axis is up"
    )
    origin = parser.add_argument_group("origin").add_mutually_exclusive_group()
    origin.add_argument("--origin", type=int, metavar="ID")
    origin.add_argument(
        "--origin-at", nargs=3, type=number(), metavar=("X", "Y", "Z"), help="in the map as it is"
    )


def run(args: argparse.Namespace) -> None:
    either.check_output(args)
    wishes = _wishes(args)
    found, _ = either.read(args)
    by = alignment(found, wishes)
    result = moved_markers(found, by) if isinstance(found, MarkerMap) else moved(found, by)
    turn = np.degrees(np.arccos(np.clip(0.5 * (np.trace(by.rotation) - 1.0), -1.0, 1.0)))
    shift = ", ".join(f"{value:.4f}" for value in by.translation)
    print(f"scaled by {by.scale:.6g}, turned by {turn:.3f} deg, shifted by ({shift}) m")
    if isinstance(found, MarkerMap) and by.scale != 1.0:
        print("the sizes of the markers are scaled as well")
    either.write(args, result)


def _wishes(args: argparse.Namespace) -> Wishes:
    names = ("scale", "distance", "up", "floor", "upright", "origin", "origin_at")
    if all(getattr(args, name) is None for name in names):
        raise UsageError("say what to align: --scale, --distance, --up, --floor, --upright, "
                         "--origin or --origin-at")  # fmt: skip
    distance = None
    if args.distance is not None:
        one, other, apart = args.distance
        try:
            distance = int(one), int(other), float(apart)
        except ValueError:
            raise UsageError(f"--distance takes two ids and metres, got {args.distance}") from None
        if not 0.0 < distance[2] < np.inf:
            raise UsageError(f"--distance: {apart} is not a length")
    return Wishes(
        args.scale, distance, _vector(args.up), tuple(args.floor or ()), args.upright, args.origin,
        _vector(args.origin_at),
    )  # fmt: skip


def _vector(values: list[float] | None) -> Array | None:
    return None if values is None else np.array(values)
