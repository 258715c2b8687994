# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Sequences of rendered images: rendered and encoded by all cores, in order, a few at a time."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from rs_localizer.simulation.frames import middle_stamp
from rs_localizer.simulation.renderer import Renderer
from rs_localizer.simulation.settings import Encoding
from rs_localizer.simulation.true_motion import TrueMotion, TrueState

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True, slots=True, eq=False)
class RenderedFrame:
    """One image; ``stamp_ns`` is the exposure of the first row, the middle row follows."""

    stamp_ns: int
    middle_ns: int
    format: str
    data: bytes
    first_row: TrueState  # one instant: at stamp_ns
    middle_row: TrueState  # one instant: at middle_ns


def rendered_frames(
    renderer: Renderer,
    motion: TrueMotion,
    stamps_ns: Sequence[int],
    encoding: Encoding,
    seed: int = 0,
) -> Iterator[RenderedFrame]:
    """The frames of a camera along a motion.

    Args:
        stamps_ns: exposure of the first row of each frame, see ``simulation.frame_stamps``.
        seed: each image has its own noise, from this and its place in the list.
    """
    now = np.zeros(1)

    def frame(numbered: tuple[int, int]) -> RenderedFrame:
        index, stamp_ns = numbered
        middle_ns = middle_stamp(renderer.camera, stamp_ns)
        return RenderedFrame(
            stamp_ns=stamp_ns,
            middle_ns=middle_ns,
            format=encoding.format,
            data=encoding(renderer.image(motion, stamp_ns, (seed, index))),
            first_row=motion.state(stamp_ns, now),
            middle_row=motion.state(middle_ns, now),
        )

    yield from in_order(frame, enumerate(stamps_ns))


def in_order(work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """``map`` with a thread per core; only a few results wait, however slowly they are taken."""
    workers = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2
    waiting: deque[Future[R]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(work, item))
                if len(waiting) > 2 * workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
