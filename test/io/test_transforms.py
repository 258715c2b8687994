# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The frames of a recording: chains of transforms, and what cannot be answered is said."""

from types import SimpleNamespace as Made

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from rs_localizer.io.messages import make_header
from rs_localizer.io.transforms import TransformError, TransformTree

Numbers = tuple[float, ...]
NAN = float("nan")
HALF_TURN = (0.0, 0.0, 1.0, 0.0)
NO_TURN = (0.0, 0.0, 0.0, 1.0)


def tf(parent: str, child: str, t: Numbers, q: Numbers, stamp_ns: int = 0) -> Made:
    place, turn = (Made(**dict(zip("xyzw", values, strict=False))) for values in (t, q))
    header = make_header(lambda _, **fields: Made(**fields), stamp_ns, parent)
    transform = Made(translation=place, rotation=turn)
    return Made(transforms=[Made(header=header, child_frame_id=child, transform=transform)])


# Parent, translation and quaternion of each frame; of the base, at two times.
STATIC = {
    "mast": ("base", (0.4, 0.3, 0.9), (0.1, -0.2, 0.3, 0.927361849549570)),
    "camera": ("mast", (0.0, 0.1, 0.25), (-0.5, 0.5, -0.5, 0.5)),
    "/lidar": ("/base", (-0.2, 0.0, 1.3), (0.9, 0.1, -0.4, -0.141421356237309)),
}
LAST_NS = 1_033_333_333
ODOMETRY = {
    LAST_NS: ((1.1, 2.1, 0.1), (0.0, 0.1, -0.6, -0.793725393319377)),
    10**9: ((1.0, 2.0, 0.1), (0.0, 0.0, 0.6, 0.8)),
}


@pytest.fixture
def tree() -> TransformTree:
    tree = TransformTree()
    for child, (parent, t, q) in STATIC.items():
        tree.add(tf(parent, child, t, q), static=True)
    for stamp_ns, (t, q) in ODOMETRY.items():
        tree.add(tf("odom", "base", t, q, stamp_ns), static=False)
    return tree


def matrix(t: Numbers, q: Numbers) -> np.ndarray:
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = Rotation.from_quat(q).as_matrix(), t
    return found


@pytest.mark.parametrize("target", ["odom", "base", "camera", "lidar"])
@pytest.mark.parametrize("stamp_ns", [None, 10**9, 1_012_345_678])
def test_chains_are_products_of_matrices_in_both_directions(tree, target, stamp_ns):
    """What tf2 itself says of such chains, test/real_ros compares."""
    times = sorted(ODOMETRY)
    places, turns = (np.array([ODOMETRY[time][k] for time in times]) for k in (0, 1))
    now = LAST_NS if stamp_ns is None else stamp_ns
    share = (now - times[0]) / (times[1] - times[0])
    turn = Slerp([0.0, 1.0], Rotation.from_quat(turns))(share).as_quat()
    in_odom = {"odom": np.eye(4)}
    in_odom["base"] = matrix((1.0 - share) * places[0] + share * places[1], turn)
    for child, (parent, t, q) in STATIC.items():
        in_odom[child.strip("/")] = in_odom[parent.strip("/")] @ matrix(t, q)
    for source, placed in in_odom.items():
        expected = np.linalg.inv(in_odom[target]) @ placed
        found = tree.lookup(target, source, stamp_ns)
        np.testing.assert_allclose(found.rotation, expected[:3, :3], atol=1e-14)
        np.testing.assert_allclose(found.translation, expected[:3, 3], atol=1e-14)


def test_what_moves(tree):
    assert not tree.moves("base", "camera")
    assert not tree.moves("lidar", "camera")  # through the base, which moves with both
    assert tree.moves("odom", "camera")
    assert not tree.moves("camera", "camera")
    # Static by the last word on it.
    tree.add(tf("odom", "base", (0.0, 0.0, 0.0), NO_TURN), static=True)
    assert not tree.moves("odom", "camera")
    assert tree.lookup("odom", "base", 5).translation.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("target", "source", "stamp_ns", "text"),
    [
        ("nowhere", "camera", None, "frame 'nowhere' does not exist; there are base, camera, isl"),
        ("island", "camera", None, "'island' and 'camera' are not connected"),
        ("odom", "camera", 2 * 10**9, "is known from 1.000 s to 1.033 s, not at 2.000 s"),
        ("island", "palm", 6 * 10**9, "frame 'palm' is known from 5.000 s to 5.000 s, not at 6"),
    ],
)
def test_what_cannot_be_answered(tree, target, source, stamp_ns, text):
    tree.add(tf("island", "palm", (0.0, 0.0, 3.0), NO_TURN, 5 * 10**9), static=False)
    with pytest.raises(TransformError, match=text):
        tree.lookup(target, source, stamp_ns)


def test_a_frame_that_changes_its_parent(tree):
    for stamp, parent in enumerate(("camera", "camera", "lidar", "lidar")):
        shift = (float(stamp), 0.0, 0.0)
        tree.add(tf(parent, "cup", shift, NO_TURN, (stamp + 1) * 10**9), static=False)
    assert tree.lookup("camera", "cup", 1_500_000_000).translation.tolist() == [0.5, 0.0, 0.0]
    # Between two parents it stays with the older one, where it was.
    assert tree.lookup("camera", "cup", 2_500_000_000).translation.tolist() == [1.0, 0.0, 0.0]
    assert tree.lookup("lidar", "cup", None).translation.tolist() == [3.0, 0.0, 0.0]


def test_loops_end():
    tree = TransformTree()
    for parent, child in (("a", "b"), ("b", "c"), ("c", "a")):
        tree.add(tf(parent, child, (1.0, 0.0, 0.0), NO_TURN), static=True)
    tree.add(tf("d", "e", (0.0, 0.0, 0.0), NO_TURN), static=True)
    for stamp_ns in (None, 5):
        with pytest.raises(TransformError, match="loop"):
            tree.lookup("e", "a", stamp_ns)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (tf("a", "b", (NAN, 0.0, 0.0), NO_TURN), r"not exist.*'b' in 'a' on TF the tr.*not finite"),
        (tf("a", "/b", (0.0, 0.0, 0.0), (0.0,) * 4), r"not exist.* the quat.* is not a rotation"),
        (tf("a", "b", (0.0, 0.0, 0.0), (NAN,) * 4), r"not exist.* \(nan, nan, .* is not a rot"),
        (tf("a", "b", (0.0, 0.0, 0.0), (0.0, 0.0, 0.1, 1.1)), "not exist.* is not a rotation"),
        (tf("", "b", (0.0, 0.0, 0.0), NO_TURN), "does not exist; there are none"),
        (tf("b", "/b", (0.0, 0.0, 0.0), NO_TURN), "does not exist; there are none"),
    ],
)
def test_garbage_is_left_out(wrong, text):
    tree = TransformTree()
    tree.add(wrong, static=True)
    with pytest.raises(TransformError, match=text):
        tree.lookup("a", "b", None)
    tree.add(tf("a", "b", (0.0, 0.0, 1.0), HALF_TURN), static=True)
    tree.add(wrong, static=True)
    assert tree.lookup("a", "b", None).translation.tolist() == [0.0, 0.0, 1.0]


def test_a_gap_of_garbage_between_frames_is_named():
    tree = TransformTree()
    tree.add(tf("map", "odom", (0.0, 0.0, 0.0), NO_TURN), static=True)
    tree.add(tf("odom", "base", (0.0, 0.0, 0.0), (0.0,) * 4, 10**9), static=False)
    tree.add(tf("base", "camera", (0.0, 0.0, 0.0), NO_TURN), static=True)
    with pytest.raises(TransformError, match="not connected; of 'base' in 'odom' on TF the quat"):
        tree.lookup("map", "camera", None)
    tree.add(tf("odom", "base", (0.0, 0.0, 0.0), NO_TURN, 2 * 10**9), static=False)
    assert tree.lookup("map", "camera", None).translation.tolist() == [0.0, 0.0, 0.0]
    with pytest.raises(TransformError, match="'no' does not exist; there are base, camera, map, o"):
        tree.lookup("map", "no", None)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 3.0, np.pi - 1e-7])
def test_between_two_samples_it_turns_evenly(angle):
    rng = np.random.default_rng(0)
    for _ in range(20):
        axis = rng.normal(size=3)
        older = Rotation.random(random_state=rng.integers(1000))
        newer = older * Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
        tree = TransformTree()
        for stamp_ns, rotation in ((10, older), (110, newer)):
            tree.add(
                tf("odom", "base", (0.0, 0.0, 0.0), rotation.as_quat(), stamp_ns), static=False
            )
        both = Rotation.concatenate([older, newer])
        expected = Slerp([10.0, 110.0], both)(40.0).as_matrix()
        found = tree.lookup("odom", "base", 40).rotation
        np.testing.assert_allclose(found, expected, atol=1e-12 + 1e-8 * (angle > 3.1))
