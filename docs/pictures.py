# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Draws the pictures of the pages: ``python docs/pictures.py`` writes the SVG files beside it.

Plain text, so that a change shows in a diff and a test can compare every byte.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

FIRST, LAST, GREY, RED, INK = (13, 71, 161), (249, 168, 37), "#777777", "#c62828", "#222222"


class Drawing:
    """A white sheet; coordinates in pixels, y down."""

    def __init__(self, width: int, height: int) -> None:
        self.size = width, height
        self.parts: list[str] = []

    def line(self, *points: float, colour: str = INK, width: float = 1.5, dash: str = "") -> None:
        places = " ".join(f"{x:g},{y:g}" for x, y in zip(points[::2], points[1::2], strict=True))
        style = f' stroke-dasharray="{dash}"' if dash else ""
        self.parts.append(
            f'<polyline points="{places}" fill="none" stroke="{colour}" stroke-width="{width:g}"'
            f"{style}/>"
        )

    def arrow(
        self, x: float, y: float, to_x: float, to_y: float, colour: str = INK, width: float = 1.5
    ) -> None:
        self.line(x, y, to_x, to_y, colour=colour, width=width)
        length = ((to_x - x) ** 2 + (to_y - y) ** 2) ** 0.5
        along = (to_x - x) / length * 7.0, (to_y - y) / length * 7.0
        aside = -along[1] * 0.45, along[0] * 0.45
        base = to_x - along[0], to_y - along[1]
        tip = (
            f"{to_x:.1f},{to_y:.1f} {base[0] + aside[0]:.1f},{base[1] + aside[1]:.1f} "
            f"{base[0] - aside[0]:.1f},{base[1] - aside[1]:.1f}"
        )
        self.parts.append(f'<polygon points="{tip}" fill="{colour}"/>')

    def box(
        self, x: float, y: float, width: float, height: float, fill: str, edge: str = "none"
    ) -> None:
        self.parts.append(
            f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" fill="{fill}" '
            f'stroke="{edge}"/>'
        )

    def dot(self, x: float, y: float, colour: str = INK) -> None:
        self.parts.append(f'<circle cx="{x:g}" cy="{y:g}" r="3.5" fill="{colour}"/>')

    def text(
        self, x: float, y: float, words: str, colour: str = INK, at: str = "start", size: int = 13
    ) -> None:
        self.parts.append(
            f'<text x="{x:g}" y="{y:g}" fill="{colour}" text-anchor="{at}" '
            f'font-size="{size}">{words}</text>'
        )

    def svg(self) -> str:
        width, height = self.size
        head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
            f'width="{width}" height="{height}" font-family="sans-serif">'
        )
        sheet = f'<rect width="{width}" height="{height}" fill="#ffffff"/>'
        return "\n".join([head, sheet, *self.parts, "</svg>", ""])


def of_row(tau: float) -> str:
    """The colour of a row time: blue is the first row, yellow the last."""
    share = tau + 0.5
    return "#" + "".join(
        f"{round(a + share * (b - a)):02x}" for a, b in zip(FIRST, LAST, strict=True)
    )


def row_time() -> str:
    """When each row is exposed, and what the stamp means."""
    sheet = Drawing(820, 345)
    rows, top, step = 21, 60, 9.5
    bottom = top + (rows - 1) * step
    sheet.text(120, 30, "the image", at="middle", size=15)
    for k in range(rows):
        sheet.box(30, top + k * step - 4, 180, 8, of_row(k / (rows - 1) - 0.5))
    for k, words in (
        (0, "first row, tau = -0.5"),
        (rows // 2, "middle row, tau = 0"),
        (20, "last row, tau = 0.5"),
    ):
        sheet.text(218, top + k * step + 4, words)
    origin, exposure, readout = 430.0, 46.0, 200.0
    sheet.text(600, 30, "when each row is exposed", at="middle", size=15)
    for frame in (0, 1):
        for k in range(rows):
            start = origin + frame * 330 + k * readout / (rows - 1)
            colour = of_row(k / (rows - 1) - 0.5) if not frame else "#dddddd"
            width = min(exposure, 815 - start)
            if width > 0:
                sheet.box(start, top + k * step - 4, width, 8, colour)
    sheet.text(812, bottom - 30, "next image", colour=GREY, at="end")
    sheet.arrow(400, bottom + 22, 815, bottom + 22)
    sheet.text(815, bottom + 40, "time", at="end")
    first, last = origin + exposure / 2, origin + exposure / 2 + readout
    for x, height in ((first, top - 4), ((first + last) / 2, top + 10 * step), (last, bottom)):
        sheet.line(x, height, x, bottom + 27, width=1, dash="3 3")
    stamp = first - 42
    sheet.line(stamp, top - 16, stamp, bottom + 27, colour=RED)
    sheet.text(stamp + 2, top - 20, "header.stamp", colour=RED, at="middle")
    sheet.arrow(stamp, top - 9, first, top - 9, colour=RED)
    sheet.text(first + 5, top - 6, "stamp_offset (default 0)", colour=RED)
    sheet.arrow((first + last) / 2, bottom + 58, first, bottom + 58)
    sheet.arrow((first + last) / 2, bottom + 58, last, bottom + 58)
    sheet.text((first + last) / 2, bottom + 74, "readout_time", at="middle")
    sheet.text((first + last) / 2 + 4, bottom + 40, "pose_time: mid_frame")
    sheet.text(stamp + 3, bottom + 40, "pose_time: stamp", colour=RED, at="end")
    return sheet.svg()


def scan_directions() -> str:
    """The four directions in which the shutter can move."""
    sheet = Drawing(820, 150)
    names = "top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left"
    for k, name in enumerate(names):
        left, lines = 30 + 200 * k, 15
        for i in range(lines):
            share = i / (lines - 1)
            tau = (share if name in (names[0], names[2]) else 1.0 - share) - 0.5
            if k < 2:
                sheet.box(left, 20 + 6 * i, 130, 6, of_row(tau))
            else:
                sheet.box(left + 130 / lines * i, 20, 130 / lines, 90, of_row(tau))
        ends = [(65, 28, 65, 102), (65, 102, 65, 28), (10, 65, 120, 65), (120, 65, 10, 65)][k]
        sheet.arrow(left + ends[0], ends[1], left + ends[2], ends[3], colour="#ffffff", width=2.5)
        sheet.text(left + 65, 132, name, at="middle")
    return sheet.svg()


def _triad(sheet: Drawing, x: float, y: float, axes: tuple[tuple[str, float, float], ...]) -> None:
    colours = {"x": RED, "y": "#2e7d32", "z": "#1565c0"}
    for name, along, down in axes:
        sheet.arrow(x, y, x + along, y + down, colour=colours[name], width=2)
        sheet.text(x + 1.25 * along - 4, y + 1.25 * down + 5, name, colour=colours[name])


def frames() -> str:
    """A camera that moves during the readout, and the frames of everything."""
    sheet = Drawing(820, 455)
    sheet.text(30, 30, "one image: the camera moves while its rows are read", size=15)
    _triad(sheet, 60, 200, (("x", 44, 8), ("y", 26, -26), ("z", 0, -46)))
    sheet.text(30, 235, "map (frame_id of the points)")
    places = ((-0.5, 250, 200), (0.0, 330, 178), (0.5, 412, 182))
    target = 640.0, 90.0
    sheet.dot(*target)
    sheet.text(target[0] + 9, target[1] + 5, "a point of the map")
    for tau, x, y in places:
        colour = of_row(tau)
        sheet.line(x, y, x + 34, y - 24, x + 34, y + 14, x, y, colour=colour, width=2.5)
    sheet.line(
        *(250, 200, 290, 184, 330, 178, 372, 178, 412, 182), colour=GREY, width=1, dash="4 3"
    )
    sheet.line(330, 178, *target, colour=of_row(0.0), width=1.2)
    sheet.text(470, 160, "visible in the row exposed at that moment", colour=GREY)
    for (tau, x, y), words in zip(places, ("first row", "middle row", "last row"), strict=True):
        sheet.text(x - 5, y + 33, words, colour=of_row(tau) if tau < 0.5 else "#b26a00")
    sheet.text(
        250, 256, "pose: camera_from_map at the middle row; twist: how it changes over the rows"
    )
    sheet.line(30, 275, 790, 275, colour="#cccccc", width=1)
    away, near, front = ("z", 26.0, -22.0), ("z", -26.0, 22.0), ("x", 26.0, -22.0)
    right, down, up = ("x", 46.0, 0.0), ("y", 0.0, 42.0), ("y", 0.0, -42.0)
    triads = (
        ("camera (optical frame)", "z forward", (right, down, away)),
        ("base_frame (REP-103)", "x forward, z up", (front, ("y", -46.0, 0.0), ("z", 0.0, -42.0))),
        ("marker or board of a map", "middle; z to the viewer", (right, up, near)),
        ("--board without a map", "first corner; z away", (right, down, away)),
    )
    for k, (name, note, axes) in enumerate(triads):
        x = 90 + 200 * k
        _triad(sheet, x, 362, axes)
        sheet.text(x - 60, 298, name)
        sheet.text(x - 60, 444, note, colour=GREY)
    return sheet.svg()


def vibration() -> str:
    """How far a camera turns within one image: steady, shaken, and a gyroscope's samples of it."""
    sheet = Drawing(820, 270)
    left, right, middle, high = 70.0, 600.0, 140.0, 90.0
    sheet.text(left, 30, "turn of the camera within one image (rotation about one axis)", size=15)
    sheet.arrow(left - 10, middle + 95, right + 30, middle + 95)
    sheet.text(right + 36, middle + 99, "row time")
    for tau in (-0.5, 0.0, 0.5):
        x = left + (tau + 0.5) * (right - left)
        sheet.line(x, middle + 90, x, middle + 100)
        sheet.text(x, middle + 116, f"{tau:g}", at="middle")

    def turn(tau: float, shaken: bool) -> float:
        # The basis of estimator.md: no value and no slope at the middle row.
        fast, slow = 10.0 * math.pi * tau, 6.0 * math.pi * tau
        swing = 0.35 * (math.cos(slow) - 1.0) + 0.05 * (math.sin(fast) - fast)
        return 0.9 * tau + (swing if shaken else 0.0)

    def place(tau: float, shaken: bool) -> tuple[float, float]:
        return left + (tau + 0.5) * (right - left), middle - high * turn(tau, shaken)

    taus = [k / 120 - 0.5 for k in range(121)]
    sheet.line(*(x for tau in taus for x in place(tau, False)), colour=GREY, dash="6 4")
    sheet.line(*(round(x, 1) for tau in taus for x in place(tau, True)), colour="#0d47a1", width=2)
    for k in range(13):
        x, y = place(k / 12 - 0.5, True)
        sheet.dot(round(x, 1), round(y, 1), RED)
    for k, (colour, words) in enumerate(
        (
            (GREY, "pose and twist (x)"),
            ("#0d47a1", "with vibration (d)"),
            (RED, "gyroscope samples"),
        )
    ):
        sheet.line(right + 20, 70 + 24 * k, right + 44, 70 + 24 * k, colour=colour, width=3)
        sheet.text(right + 52, 75 + 24 * k, words, size=12)
    return sheet.svg()


def rigs() -> str:
    """A wall through rolling shutters that rise, and a wall before a camera at rest that fits."""
    sheet = Drawing(820, 300)
    sheet.text(
        20, 28, "a wall seen while rising (blue), and a tilted one while stationary (red)", size=15
    )

    def wall(x: float, y: float, wide: float, high: float, colour: str, dash: str) -> None:
        for k in range(5):
            part = k / 2 - 1.0
            sheet.line(
                x - wide, y + part * high, x + wide, y + part * high, colour=colour, dash=dash
            )
            sheet.line(
                x + part * wide, y - high, x + part * wide, y + high, colour=colour, dash=dash
            )

    # Rows read downwards follow the wall as it sinks in the image and stretch it; rows read upwards
    # meet it and squeeze it. A wall that leans to the side, and nearer, is stretched in both.
    cases = (
        ("one camera", (1.25,), "fits: motion unknown"),
        ("two parallel", (1.25, 1.25), "fits both: motion unknown"),
        ("two opposed", (1.25, 0.8), "fits one only: motion known"),
    )
    x = 90.0
    for name, stretches, verdict in cases:
        sheet.text(x - 50, 62, name)
        for stretch in stretches:
            y, down = 160.0, stretch > 1.0
            sheet.box(x - 60, y - 80, 120, 160, "#f5f5f5", GREY)
            wall(x, y, 40, 40 * stretch, "#0d47a1", "")
            wall(x, y, 40, 50, RED, "5 4")
            ends = (y - 70, y + 70) if down else (y + 70, y - 70)
            sheet.arrow(x + 52, ends[0], x + 52, ends[1], colour=GREY)
            x += 140
        sheet.text(x - 140 * len(stretches) - 50, 266, verdict, colour=GREY)
        x += 40
    sheet.text(20, 292, "arrows: the shutter", colour=GREY)
    return sheet.svg()


PICTURES: dict[str, Callable[[], str]] = {
    "row_time.svg": row_time,
    "scan_directions.svg": scan_directions,
    "frames.svg": frames,
    "vibration.svg": vibration,
    "rigs.svg": rigs,
}


def main() -> None:
    for name, draw in PICTURES.items():
        Path(__file__).with_name(name).write_text(draw(), encoding="utf-8")


if __name__ == "__main__":
    main()
