"""What pictures show: titles, ranges that one outlier does not stretch, contrast, no blank band."""

from __future__ import annotations

import numpy as np
import pytest

from rs_localizer.evaluation import plots
from rs_localizer.evaluation.metrics import Errors
from rs_localizer.evaluation.plots import BLUE, ORANGE
from rs_localizer.io.trajectories import Trajectory

COUNT = 200
RNG = np.random.default_rng(0)
STAMPS = np.arange(COUNT, dtype=np.int64) * 33_000_000
WAY = np.cumsum(0.02 * RNG.normal(size=(COUNT, 3)), axis=0)
STILL = np.tile([0.0, 0.0, 0.0, 1.0], (COUNT, 1))


def luminance(color: str) -> float:
    """Relative luminance of WCAG 2.1."""
    parts = np.array([int(color[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_colors_stand_out_from_white_and_from_each_other() -> None:
    for color in (BLUE, ORANGE):
        assert 1.05 / (luminance(color) + 0.05) > 4.5
    assert (luminance(ORANGE) + 0.05) / (luminance(BLUE) + 0.05) > 2.0


def test_one_outlier_stretches_no_axis() -> None:
    far = WAY.copy()
    far[50] = [400.0, -300.0, 90.0]
    figure = plots.trajectories(None, {"r6p_vcwt": Trajectory(STAMPS, far, STILL)})
    for axes, other in zip(figure.axes, (1, 2), strict=True):
        for limits, column in ((axes.get_xlim(), 0), (axes.get_ylim(), other)):
            assert limits[1] - limits[0] < 3 * np.ptp(WAY[:, [0, other]], axis=0).max()
            assert limits[0] < np.median(WAY[:, column]) < limits[1]
    sizes = np.abs(RNG.normal(size=COUNT))
    large = np.where(np.arange(COUNT) == 50, 1e6, sizes)
    figure = plots.errors({"r6p_vcwt": Errors(STAMPS, large, sizes, sizes)}, {})
    assert figure.axes[0].get_ylim()[1] < 100 * 1e3 * sizes.max()  # mm


def test_few_values_are_all_shown() -> None:
    part = Trajectory(STAMPS[:5], np.diag([1.0, 2.0, 3.0, 4.0, 500.0])[:, 2:], STILL[:5])
    figure = plots.trajectories(None, {"r6p_vcwt": part})
    assert figure.axes[1].get_ylim()[1] > 500.0


def test_every_figure_has_a_title() -> None:
    way = Trajectory(STAMPS, WAY, STILL)
    ones = np.ones(COUNT)
    errors = {"r6p_vcwt": Errors(STAMPS, ones, ones, ones)}
    pixels = RNG.uniform(100.0, 300.0, (20, 2))
    picture = np.zeros((480, 640), np.uint8)
    for figure in (
        plots.trajectories(way, {"r6p_vcwt": way}),
        plots.errors(errors, errors),
        plots.inliers(STAMPS, {"r6p_vcwt": ones}, ones, ones, "true matches"),
        plots.residuals(picture, pixels, {"r6p_vcwt": pixels + 0.1}, "A frame"),
    ):
        assert figure._suptitle.get_text()


@pytest.mark.parametrize(("width", "height"), [(400.0, 80.0), (200.0, 200.0), (150.0, 300.0)])
def test_no_band_stays_blank_around_the_pictures_of_residuals(width: float, height: float) -> None:
    pixels = RNG.uniform(0.0, 1.0, (50, 2)) * [width, height] + 100.0
    seen = {"r6p_vcwt": pixels + 0.1, "p3p": pixels + 1.0}
    figure = plots.residuals(np.zeros((600, 700), np.uint8), pixels, seen, "A frame")
    figure.draw_without_rendering()
    boxes = [axes.get_position() for axes in figure.axes]
    drawn = sum(axes.get_window_extent().height for axes in figure.axes) / len(boxes)
    blank = figure.bbox.height - drawn
    assert blank < 1.6 * figure.dpi  # inches: the titles and the words below
