"""What is to be said of a map that was built."""

from __future__ import annotations

import numpy as np

from rs_localizer.mapping.build import Built

PICTURES = ("map.png", "residuals.png")


def rows(built: Built, images: int, views: int) -> list[tuple[str, str]]:
    """The table: what was measured, name and text.

    Args:
        images: of the recording.
        views: of them that were looked at.
    """
    refined, covariances = built.refined, built.landmarks.covariances
    assert covariances is not None
    spread = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    unit, factor = ("mm", 1e3) if built.placement.scaled else ("units of the map / 1000", 1e3)
    keyframes, blurred = len(built.keyframes.chosen), int(built.keyframes.blurred.sum())
    joined = f"{built.structure.parts[0]} of {keyframes}"
    others = built.structure.parts[1:]
    readout = f"{1e3 * built.camera.readout_time:.2f} ms"
    if np.isfinite(refined.readout_time_deviation):
        readout += f" (estimated, deviation {1e3 * refined.readout_time_deviation:.2f} ms)"
    return [
        ("images", f"{images}, {views} used, {blurred} of them blurred"),
        ("keyframes that hang together", joined + (f"; other parts: {others}" if others else "")),
        ("images with a pose", f"{len(built.posed)} of {views}"),
        ("landmarks", f"{len(built.landmarks)} of {len(built.structure.points)} points"),
        ("deviation of a landmark", f"{factor * np.median(spread):.1f} {unit} (median)"),
        ("noise before the refinement", f"{refined.before:.2f} px"),
        ("noise after it", f"{refined.after:.2f} px"),
        ("readout time", readout),
        ("scale", built.placement.told),
        ("z is up", _up(built)),
    ]


def written(built: Built, images: int, views: int) -> str:
    """The same as a page of Markdown, with the pictures."""
    table = "\n".join(f"| {name} | {text} |" for name, text in rows(built, images, views))
    shown = "\n\n".join(f"![{name}]({name})" for name in PICTURES)
    return f"# Map\n\n| | |\n|---|---|\n{table}\n\n{shown}\n"


def _up(built: Built) -> str:
    if built.placement.levelled:
        return "as in the marker map"
    return "as the camera was held on average (a guess)"
