# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Every image of a rendered recording through both live nodes, held against replay's result.

    python -m benchmarks.image_flight flight poses -p pose_time:=mid_frame

``flight`` is what ``simulate --images`` wrote, ``poses`` what ``replay`` made of its markers with
the same parameters. Each image is sent when the one before has been answered, so that none is
dropped: then the nodes have to say the same, bit for bit.

    python -m benchmarks.image_flight flight poses -p pose_time:=mid_frame --map map.npz

does so by features and a map of landmarks, of which ``detect --features sift`` and ``replay --map``
made ``poses``.

    python -m benchmarks.image_flight flight --rate 30

sends the images at a camera's pace instead, and tells how long the poses take.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.flight import KINDS, POSE, flying
from rs_localizer.io.bags import open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.ros.node.conversion import copy_message


@dataclass(frozen=True, slots=True)
class Agreement:
    """How the live nodes and replay agree."""

    images: int
    live: Mapping[str, int]  # messages by topic
    replayed: Mapping[str, int]
    identical: Mapping[str, int]

    @property
    def complete(self) -> bool:
        """Whether all messages are the same, and there is any."""
        return self.live == self.replayed == self.identical and self.live[POSE] > 0


def fly(
    images: Path, replayed: Path, parameters: list[str], landmarks: Path | None = None
) -> Agreement:
    """Start both nodes, send them all images, and compare.

    Args:
        images: directory with the bag, the marker map and the parameters.
        replayed: directory that replay wrote.
        parameters: further ones of the localizer, ``name:=value``.
        landmarks: map file of features; None: markers.

    Raises:
        ValueError: when a node ends or does not answer.
    """
    offline = _offline(replayed)
    with flying(images, parameters, landmarks) as flight:
        count = flight.send(images, offline)
        live = flight.heard
    return Agreement(
        count,
        {topic: len(found) for topic, found in live.items()},
        {topic: len(found) for topic, found in offline.items()},
        {
            topic: sum(live[topic].get(stamp) == message for stamp, message in found.items())
            for topic, found in offline.items()
        },
    )


def latencies(
    images: Path, rate: float, parameters: list[str], landmarks: Path | None = None
) -> tuple[int, list[float]]:
    """Start both nodes and send them the images at a steady rate, as a camera does.

    Args:
        images: directory with the bag, the marker map and the parameters.
        rate: Hz.
        parameters: further ones of the localizer, ``name:=value``; poses must keep the stamps.

    Returns:
        how many images were sent, and the seconds from sending an image to hearing its pose, of
        those that were answered.

    Raises:
        ValueError: when a node ends.
    """
    with flying(images, parameters, landmarks) as flight:
        sent = flight.pace(images, rate)
        answered = flight.arrivals
    return len(sent), [answered[stamp] - sent[stamp] for stamp in answered.keys() & sent.keys()]


def _offline(replayed: Path) -> dict[str, dict[int, Any]]:
    found: dict[str, dict[int, Any]] = {topic: {} for topic in KINDS}
    with open_bag(replayed / "result") as bag:
        for topic, _, message in bag.messages([topic for topic in KINDS if topic in bag.topics]):
            found[topic][stamp_ns(message)] = copy_message(message, message.__msgtype__)
    return found


def main(arguments: list[str] | None = None) -> int:
    """Print how the nodes and replay agree; 1 if they do not."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.image_flight",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("images", type=Path, help="directory that simulate --images wrote")
    parser.add_argument("replayed", type=Path, nargs="?", help="directory that replay wrote")
    parser.add_argument("--rate", type=float, metavar="HZ", help="of the images, to time the poses")
    parser.add_argument(
        "-p", dest="parameters", action="append", default=[], metavar="NAME:=VALUE",
        help="parameter of the localizer, as for replay",
    )  # fmt: skip
    parser.add_argument("--map", type=Path, metavar="FILE", help="of landmarks, for features")
    options = parser.parse_args(arguments)
    if (options.replayed is None) == (options.rate is None):
        parser.error("give either what replay wrote or --rate")
    # Nobody else's nodes shall hear these images.
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    if options.rate is not None:
        sent, taken = latencies(options.images, options.rate, options.parameters, options.map)
        if not taken:
            raise ValueError(f"none of {sent} images was answered")
        middle, most = 1e3 * np.quantile(taken, [0.5, 0.95])
        sys.stdout.write(
            f"{len(taken)} poses of {sent} images at {options.rate:g} Hz, from image to pose: "
            f"p50 {middle:.1f} ms, p95 {most:.1f} ms\n"
        )
        return 0
    found = fly(options.images, options.replayed, options.parameters, options.map)
    sys.stdout.write(f"{found.images} images\n")
    for topic in KINDS:
        sys.stdout.write(
            f"{topic}: {found.live[topic]} live, {found.replayed[topic]} replayed, "
            f"{found.identical[topic]} identical\n"
        )
    return 0 if found.complete else 1


if __name__ == "__main__":
    sys.exit(main())
