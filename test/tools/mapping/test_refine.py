# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Refined maps and surveyed markers: near the truth, honest, and wrong shutters named."""

from dataclasses import replace

import numpy as np
import pytest
from dense import normal_of
from scenes import READOUT, SQUARE, Walk, camera, ring, spot, walk
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.transforms import Transform
from rs_localizer.markers.prints import Marker, Pose
from rs_localizer.tools.adjust.problem import Problem
from rs_localizer.tools.adjust.system import Factored
from rs_localizer.tools.adjust.variables import Freedom, Unknowns
from rs_localizer.tools.mapping.gauge import of_the_shape, through
from rs_localizer.tools.mapping.map_keypoints import MapFreedom, MapObservations
from rs_localizer.tools.mapping.refinement import DRIFT, RefinedMap, Refinement, fit_shutter, refine
from rs_localizer.tools.mapping.survey import Survey, survey
from rs_localizer.tools.mapping.unknown_markers import Chained, Filmed, Spotted, chain
from rs_localizer.tools.readout_belief import ShutterFit

VIDEO = np.arange(0.0, 1.2, 1.0 / 30.0)


def errors(found: RefinedMap, truth: Walk) -> np.ndarray:
    """Of the refined landmarks (n,), m, but for position, orientation and size of the whole."""
    ours, true = found.points[found.refined], truth.points[found.refined]
    return np.linalg.norm(through(ours, true)(ours) - true, axis=1)


def small_problem() -> tuple[Problem, Unknowns]:
    rng = np.random.default_rng(0)
    scene = walk(rng, np.array([0.0, 0.03, 0.06, 1.0, 2.0]), points=120, count=25)
    whole = Refinement(camera(), 0.0, scene.seen, scene.start, MapFreedom())
    return whole.problem(Freedom(lens=True, angular_velocity=2.0, linear_velocity=1.0)), whole.state


def test_modes_are_the_errors_of_the_motion_that_move_landmarks_most():
    """By dense algebra: whitened, and the largest of landmarks in their own deviations."""
    problem, state = small_problem()
    matrix, size = normal_of(problem.groups, problem.terms(state, 5.0))[0], problem.groups.kept
    of_motion, crossed, own = matrix[:size, :size], matrix[:size, size:], matrix[size:, size:]
    reduced = of_motion - crossed @ np.linalg.solve(own, crossed.T)
    modes = Factored(problem.system(state, 5.0)).modes(12)
    np.testing.assert_allclose(modes.T @ reduced @ modes, np.eye(12), atol=1e-5)
    moves = np.linalg.solve(own, crossed.T @ modes)
    expected = eigh(of_motion, reduced, eigvals_only=True)[:-13:-1] - 1.0
    np.testing.assert_allclose(np.einsum("ik,ij,jk->k", moves, own, moves), expected, rtol=0.02)


@pytest.fixture(scope="module")
def video() -> Walk:
    return walk(np.random.default_rng(3), VIDEO)


@pytest.fixture(scope="module")
def right(video) -> RefinedMap:
    return refine(camera(), video.seen, video.start)


def test_a_global_shutter_bends_the_map_and_the_rolling_one_does_not(video, right):
    bent = refine(camera(0.0), video.seen, video.start, stamp_offset=0.5 * READOUT)
    assert np.median(errors(right, video)) < 0.3 * np.median(errors(bent, video))
    assert right.after < 0.4 < bent.after
    assert right.before > 2.0 * right.after
    assert right.deviation == pytest.approx(0.3, rel=0.1)
    assert np.mean(right.inliers) > 0.98
    # The map as a whole stays where it was.
    whole = through(right.points[right.refined], video.start.points[right.refined])
    assert whole.scale == pytest.approx(1.0, abs=0.02)
    assert np.linalg.norm(whole.translation) < 0.04


def test_errors_of_the_motion_are_laid_where_the_map_is(video, right):
    """A map that is given 5 % too large takes its motion along, and errors of the motion."""
    middle = video.points.mean(axis=0)
    start = replace(video.start, points=middle + 1.05 * (video.start.points - middle))
    found = refine(camera(), video.seen, start, MapFreedom(drifts=2))
    ours, usual = (np.ptp(one.poses()[1], axis=0) for one in (found, right))
    np.testing.assert_allclose(ours, 1.05 * usual, rtol=0.02)
    for drift in found.drifts:
        off = np.abs(drift.poses()[1] - found.poses()[1]).max()
        assert 0.0 < off < 0.05 * DRIFT  # m: a deviation is some millimetres


def test_a_wrong_readout_time_is_named(video, right):
    assert not right.readout_check.differs
    wrong = refine(camera(0.4 * READOUT), video.seen, video.start).readout_check
    assert wrong.differs
    # One step brings it most of the way.
    assert abs(wrong.estimated - READOUT) < 0.3 * READOUT
    assert f"{0.4e3 * READOUT:.1f} ms was given" in wrong.message


def test_readout_time_and_scan_direction_are_found(video):
    reverse = replace(camera(0.0), scan_direction=ScanDirection.BOTTOM_TO_TOP)
    found = refine(reverse, video.seen, video.start, MapFreedom(readout_time=True))
    assert found.readout_time_deviation < 3e-4
    assert abs(found.readout_time + READOUT) < 4.0 * found.readout_time_deviation
    as_found = found.camera_as_found
    assert as_found.scan_direction == ScanDirection.TOP_TO_BOTTOM
    assert as_found.readout_time == -found.readout_time


def test_landmarks_of_known_place_hold_frame_and_size(video):
    shrunk = replace(
        video.start, points=0.8 * video.start.points, positions=0.8 * video.start.positions
    )
    deviations = np.full(len(video.points), np.inf)
    often = np.argsort(-np.bincount(video.seen.landmarks, minlength=len(video.points)))[:10]
    deviations[often] = 1e-4
    points = shrunk.points.copy()
    points[often] = video.points[often]
    found = refine(
        camera(), video.seen, replace(shrunk, points=points), MapFreedom(deviations=deviations)
    )
    off = found.points - video.points
    spread = np.sqrt(np.trace(found.covariances, axis1=1, axis2=2))
    near = found.refined & (spread < 2.0 * np.median(spread[found.refined]))
    assert np.median(np.linalg.norm(off[near], axis=1)) < 0.02
    squared = np.einsum(
        "ni,nij,nj->n", off[near], np.linalg.inv(found.covariances[near]), off[near]
    )
    assert 0.3 < np.mean(squared) / 3.0 < 3.0


def shifted(seen: MapObservations, by: int) -> MapObservations:
    """The second half of the images sees other landmarks."""
    late = seen.images >= len(seen.stamps_ns) // 2
    return replace(seen, landmarks=seen.landmarks + np.where(late, by, 0))


def test_what_is_no_map_is_refused(video):
    count = len(video.points)
    twice = replace(video.start, points=np.concatenate([video.start.points] * 2))
    with pytest.raises(ValueError, match=r"fall into 2 parts .* \(of 18, 18 images\)"):
        refine(camera(), shifted(video.seen, count), twice)
    own = replace(video.seen, landmarks=np.arange(len(video.seen.landmarks)))
    many = replace(video.start, points=np.zeros((len(own.landmarks), 3)))
    with pytest.raises(ValueError, match="no overlap: no landmark is seen by two images"):
        refine(camera(), own, many)
    with pytest.raises(ValueError, match="landmarks that are not among the 10"):
        refine(camera(), video.seen, replace(video.start, points=np.zeros((10, 3))))
    one = np.full(count, np.inf)
    one[0] = 0.001
    with pytest.raises(ValueError, match="1 landmarks of known place do not fix a map"):
        refine(camera(), video.seen, video.start, MapFreedom(deviations=one))


def test_step_and_covariances_are_those_of_the_dense_system():
    problem, state = small_problem()
    matrix, slope = normal_of(problem.groups, problem.terms(state, 5.0))
    inverse, factored = np.linalg.inv(matrix), Factored(problem.system(state, 5.0))
    expected = -np.linalg.solve(matrix, slope)
    found = factored.step()
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())
    of_landmarks, shared = factored.block_covariances()
    motion, kept = problem.groups.motion, problem.groups.kept
    for k, covariance in enumerate(of_landmarks):
        at = slice(kept + 3 * k, kept + 3 * k + 3)
        np.testing.assert_allclose(covariance, inverse[at, at], rtol=1e-5, atol=1e-12)
    at = slice(motion, kept)
    np.testing.assert_allclose(shared, inverse[at, at], rtol=1e-5, atol=1e-12)


def fit(readout: float) -> tuple[RefinedMap, ShutterFit | None]:
    scene = walk(np.random.default_rng(1), VIDEO, points=100, count=40, readout=readout)
    return fit_shutter(camera(0.0), scene.seen, scene.start, MapFreedom())


def test_a_rolling_shutter_is_found():
    refined, shutter = fit(READOUT)
    assert shutter.visible
    assert shutter.direction == ScanDirection.TOP_TO_BOTTOM
    assert refined.readout_time == pytest.approx(READOUT, abs=4.0 * shutter.deviation)
    assert shutter.deviation < 1e-3


def test_a_global_shutter_is_left_alone():
    refined, shutter = fit(0.0)
    assert not shutter.visible
    assert refined.readout_time == 0.0


def test_images_that_no_smooth_motion_joins_have_poses_of_their_own():
    """As those of a time lapse, whose stamps are nearer than its images were, some by much."""
    scene = walk(np.random.default_rng(1), np.arange(0.0, 12.0, 1.0), readout=0.0)
    stamps = scene.seen.stamps_ns[0] + np.cumsum(np.tile([5, 50, 50], 4)) * 10**6
    seen = replace(scene.seen, stamps_ns=stamps)
    refined, shutter = fit_shutter(camera(0.0), seen, scene.start, MapFreedom())
    assert shutter is None
    assert refined.apart
    assert refined.fit_share > 0.95
    assert refined.deviation == pytest.approx(0.3, rel=0.15)


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
def right_survey(spotted) -> Survey:
    return survey(Filmed(camera(), spotted), MARKERS)


def test_markers_are_where_they_are(right_survey, poses):
    found = right_survey
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
def test_a_wrong_readout_time_of_a_survey_is_named(seed, refused):
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
