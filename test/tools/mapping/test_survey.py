# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Surveying markers of an own projector, and deviations of a shape, wherever it lies."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import READOUT, SQUARE, camera, ring, spot
from scipy.spatial.transform import Rotation

from rs_localizer.io.transforms import Transform
from rs_localizer.markers.prints import Marker, Pose
from rs_localizer.tools.mapping.gauge import of_the_shape
from rs_localizer.tools.mapping.survey import Survey, survey
from rs_localizer.tools.mapping.unknown_markers import Chained, Filmed, Spotted, chain

SIZE = 0.15
STAMPS = np.arange(0.0, 3.0, 1.0 / 30.0)
MARKERS = [Marker.at("4x4_50", id_, SIZE, Pose()) for id_ in range(50)]

Poses = list[tuple[np.ndarray, np.ndarray]]


@pytest.fixture(scope="module")
def poses() -> Poses:
    return ring(np.random.default_rng(0), 5, SIZE)


@pytest.fixture(scope="module")
def spotted(poses) -> list[Spotted]:
    return spot(np.random.default_rng(1), poses, SIZE, STAMPS)


def deviations_of(found: Survey) -> np.ndarray:
    return np.sqrt(np.diagonal(found.covariance)).reshape(-1, 6)


def check(found: Survey, poses: Poses, limit: float) -> None:
    """Every coordinate within 4.5 deviations and a limit (m)."""
    turn, origin = poses[found.markers[0].id]
    for marker, deviations in zip(found.markers, deviations_of(found), strict=True):
        own_turn, own_place = poses[marker.id]
        off = marker.pose.position - turn.T @ (own_place - origin)
        turned = Rotation.from_matrix(marker.pose.rotation @ (turn.T @ own_turn).T).as_rotvec()
        assert np.all(np.abs(np.concatenate([off, turned])) <= 4.5 * deviations + 1e-9)
        assert np.linalg.norm(off) < limit


@pytest.fixture(scope="module")
def right(spotted) -> Survey:
    return survey(Filmed(camera(), spotted), MARKERS)


def test_markers_are_where_they_are(right, poses):
    found = right
    assert [marker.id for marker in found.markers] == [0, 1, 2, 3, 4]
    deviations = deviations_of(found)
    assert np.all(deviations[0] == 0.0)
    assert np.all((deviations[1:, :3] > 1e-5) & (deviations[1:, :3] < 0.02))
    check(found, poses, 0.03)
    assert found.apart == found.rare == ()
    assert all(marker.size == pytest.approx(SIZE) for marker in found.markers)


def only(spotted: list[Spotted], kept: list[set[int]]) -> list[Spotted]:
    """Each image shows one of these sets of markers, in turn, as far as it does."""
    parts = []
    for k, one in enumerate(spotted):
        shown = np.isin(one.markers, list(kept[k // 3 % len(kept)]))
        parts.append(replace(one, markers=one.markers[shown], quads=one.quads[shown]))
    return parts


def test_what_does_not_hang_together_is_named(spotted):
    parts = only(spotted, [{0, 1, 2}, {3, 4}])
    found = survey(Filmed(camera(), parts), MARKERS)
    assert [marker.id for marker in found.markers] == [0, 1, 2]
    assert [[marker.id for marker in part] for part in found.apart] == [[3, 4]]


def drawn(seed: int) -> tuple[Poses, list[Spotted]]:
    """Markers and images of another seed."""
    poses = ring(np.random.default_rng(seed), 5, SIZE)
    return poses, spot(np.random.default_rng(1000 + seed), poses, SIZE, STAMPS)


@pytest.mark.parametrize(("seed", "refused"), [(0, False), (7, True)])
def test_a_wrong_readout_time_is_named(seed, refused):
    """Of 20 seeds it is in all: few corners fit, or the images ask for another one."""
    filmed = Filmed(camera(0.3 * READOUT), drawn(seed)[1])
    if refused:
        with pytest.raises(ValueError, match=r"% of the corners fit .* check the readout time"):
            survey(filmed, MARKERS)
    else:
        check = survey(filmed, MARKERS).shutter.readout_check
        assert check.differs
        assert check.estimated == pytest.approx(READOUT, abs=6.0 * check.deviation)


@pytest.mark.parametrize("wrong", [{4: 1.04}, {2: 1.1}, {0: 1.3}])
def test_a_marker_of_another_size_is_named_and_left_out(spotted, poses, wrong):
    """The origin, too, and one that is off by a little: of 20 seeds in 20, 20 and 19."""
    sizes = [wrong.get(id_, 1.0) * SIZE for id_ in range(50)]
    markers = [Marker.at("4x4_50", id_, size, Pose()) for id_, size in enumerate(sizes)]
    found = survey(Filmed(camera(), spotted), markers)
    assert [marker.id for marker in found.misfits] == list(wrong)
    assert len(found.markers) == 4
    check(found, poses, 0.03)


@pytest.mark.parametrize(("seed", "share"), [(1, 0.5), (3, 0.5), (5, 0.3)])
def test_an_id_that_is_used_twice_is_left_out(seed, share):
    """Also if more than half of its images fit."""
    rng, turned = np.random.default_rng(seed), []
    for one in drawn(seed)[1]:  # the other one a quarter turn away
        quads = one.quads.copy()
        if rng.random() < share:
            quads[one.markers == 4] = np.roll(quads[one.markers == 4], 1, axis=1)
        turned.append(replace(one, quads=quads))
    found = survey(Filmed(camera(), turned), MARKERS)
    assert [marker.id for marker in found.misfits] == [4]
    assert [marker.id for marker in found.markers] == [0, 1, 2, 3]
    assert all(marker.size == pytest.approx(SIZE) for marker in found.markers)


def test_a_readout_time_of_which_the_seconds_disagree_is_known_less(spotted, poses, monkeypatch):
    monkeypatch.setattr("scenes.READOUT", 1.02 * READOUT)
    slower = spot(np.random.default_rng(1), poses, SIZE, STAMPS)
    alike, mixed = (
        survey(Filmed(camera(0.0), images), MARKERS).shutter
        for images in (spotted, spotted[:45] + slower[45:])
    )
    assert alike.readout_time == pytest.approx(READOUT, abs=4.0 * alike.readout_time_deviation)
    assert mixed.readout_time_deviation > 2.0 * alike.readout_time_deviation
    assert READOUT < mixed.readout_time < 1.02 * READOUT


def turned_over(chained: Chained, marker: int) -> Chained:
    """The first guess with a marker turned over as its images see it."""
    own = chained.markers[marker]
    toward = (
        np.mean([pose.translation for pose in chained.poses.values()], axis=0) - own.translation
    )
    toward /= np.linalg.norm(toward)
    mirror = np.eye(3) - 2.0 * np.outer(toward, toward)
    turned = Transform(mirror @ own.rotation @ np.diag([1.0, 1.0, -1.0]), own.translation)
    markers = {**chained.markers, marker: turned}
    back = markers[next(iter(markers))].inverse()  # the first is the origin
    return replace(
        chained,
        markers={of: back @ pose for of, pose in markers.items()},
        poses={k: back @ pose for k, pose in chained.poses.items()},
    )


@pytest.mark.parametrize("origin", [0, 2])
def test_a_marker_that_was_turned_over_is_turned_back(spotted, poses, origin, monkeypatch):
    monkeypatch.setattr(
        "rs_localizer.tools.mapping.survey.chain", lambda *given: turned_over(chain(*given), 2)
    )
    # All of it would turn it back on the way.
    found = survey(Filmed(camera(), spotted[:40]), MARKERS, origin=origin)
    assert found.rare == ()
    check(found, poses, 0.03)


COUNT = 4


def test_it_is_what_is_left_when_the_markers_are_laid_over_the_truth():
    rng = np.random.default_rng(0)
    turns = Rotation.random(COUNT, random_state=1).as_matrix()
    middles = rng.normal(size=(COUNT, 3))
    corners = 0.15 * np.einsum("mij,cj->mci", turns, SQUARE) + middles[:, None]
    root = 1e-4 * rng.normal(size=(6 * COUNT, 6 * COUNT))
    held = of_the_shape(root @ root.T, corners)
    left = []
    for _ in range(3000):
        error = (root @ rng.normal(size=6 * COUNT)).reshape(COUNT, 6)
        own = Rotation.from_rotvec(error[:, 3:])
        places = middles + error[:, :3]
        seen = own.as_matrix() @ np.swapaxes(corners - middles[:, None], 1, 2)
        ours = (np.swapaxes(seen, 1, 2) + places[:, None]).reshape(-1, 3)
        true = corners.reshape(-1, 3)
        back, _ = Rotation.align_vectors(true - true.mean(axis=0), ours - ours.mean(axis=0))
        over = back.apply(places - ours.mean(axis=0)) + true.mean(axis=0) - middles
        left.append(np.column_stack([over, (back * own).as_rotvec()]).ravel())
    np.testing.assert_allclose(np.std(left, axis=0), np.sqrt(np.diag(held)), rtol=0.07)
