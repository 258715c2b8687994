"""How the viewer is arranged when a recording opens."""

from __future__ import annotations

from typing import Any

from rs_localizer.offline.viewing import paths
from rs_localizer.offline.viewing.shapes import Eye


def blueprint(with_images: bool, eye: Eye) -> Any:
    """Scene and image on the left, what changes with time on the right, one time line below.

    Args:
        with_images: whether there are any.
        eye: from where the scene is seen.
    """
    import rerun.blueprint as rrb

    scene = rrb.Spatial3DView(
        origin=paths.MAP,
        name="map: path, covariance (95 %), landmarks, inliers",
        eye_controls=rrb.EyeControls3D(
            position=eye.position, look_target=eye.target, eye_up=eye.up
        ),
    )
    image = rrb.Spatial2DView(
        origin=paths.IMAGE,
        name=f"{'image' if with_images else 'pixels'}: inliers by row (blue first), residuals "
        "enlarged, the others red",
    )
    plots = [rrb.TimeSeriesView(origin=path, name=name) for path, name in paths.PLOTS.items()]
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(scene, image), rrb.Vertical(*plots), column_shares=[3, 2]),
        rrb.TimePanel(timeline=paths.TIMELINE, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )
