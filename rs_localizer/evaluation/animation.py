"""Pictures side by side, one after the other, as a file that a web page shows."""

from __future__ import annotations

import io
from collections.abc import Sequence

import cv2
import numpy as np
from PIL import Image as Pillow

from rs_localizer.io.video import Image

_BAR, _GAP = 30, 6  # px
_FONT, _FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.55
_COLORS = 64


def side_by_side(
    pictures: Sequence[Image],
    captions: Sequence[Sequence[str]],
    colors: Sequence[tuple[int, int, int]],
    width: int,
) -> Image:
    """Pictures (h,w,3) in a row, each ``width`` px wide below a bar with two words on it.

    The first stands on the left of the bar, the second on the right.
    """
    height = round(width * pictures[0].shape[0] / pictures[0].shape[1])
    columns = []
    for picture, caption, color in zip(pictures, captions, colors, strict=True):
        small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        bar = np.full((_BAR, width, 3), 255, np.uint8)
        for text, right in zip(caption, (False, True), strict=True):
            (length, _), _ = cv2.getTextSize(text, _FONT, _FONT_SCALE, 1)
            x = width - length - 4 if right else 4
            cv2.putText(bar, text, (x, 20), _FONT, _FONT_SCALE, color, 1, cv2.LINE_AA)
        columns += [np.vstack([bar, small]), np.full((_BAR + height, _GAP, 3), 255, np.uint8)]
    return np.asarray(np.hstack(columns[:-1]), np.uint8)


def gif(pictures: Sequence[Image], frame_rate: float) -> bytes:
    """An animated GIF of pictures (h,w,3), blue first, that is shown again and again.

    All share one palette, made of a few of them: colors do not flicker, and what stays the same
    costs nothing.
    """
    chosen = pictures[:: max(1, len(pictures) // 8)]
    sample = Pillow.fromarray(cv2.cvtColor(np.vstack(chosen), cv2.COLOR_BGR2RGB))
    palette = sample.quantize(_COLORS)
    frames = [
        Pillow.fromarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)).quantize(
            palette=palette, dither=Pillow.Dither.NONE
        )
        for picture in pictures
    ]
    file = io.BytesIO()
    # GIF counts in hundredths of a second.
    duration = 10 * max(2, round(100.0 / frame_rate))
    frames[0].save(
        file, "GIF", save_all=True, append_images=frames[1:], duration=duration, loop=0,
        optimize=True,
    )  # fmt: skip
    return file.getvalue()
