"""Kernels that few frames come to: no robot waits for the compiler in the middle of its way."""

from __future__ import annotations

from rs_localizer.estimation import averaging, frame_fit, motion_model, packing, scoring


def compile_rare() -> None:
    """Compile what the frames of :meth:`Localizer.warm_up` do not come to, or load it."""
    for part in (averaging, frame_fit, motion_model, packing, scoring):
        part.warm_up()
