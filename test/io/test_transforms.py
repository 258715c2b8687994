# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The frames of a recording: the same numbers as tf2, and what cannot be answered is said."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from rs_localizer.io.transforms import TransformError, TransformTree, from_numbers

Numbers = tuple[float, ...]
NAN = float("nan")
HALF_TURN = (0.0, 0.0, 1.0, 0.0)
NO_TURN = (0.0, 0.0, 0.0, 1.0)


def tf(parent: str, child: str, t: Numbers, q: Numbers, stamp_ns: int = 0) -> SimpleNamespace:
    """A TFMessage of one transform."""
    stamped = SimpleNamespace(
        header=SimpleNamespace(
            stamp=SimpleNamespace(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9), frame_id=parent
        ),
        child_frame_id=child,
        transform=SimpleNamespace(
            translation=SimpleNamespace(**dict(zip("xyz", t, strict=True))),
            rotation=SimpleNamespace(**dict(zip("xyzw", q, strict=True))),
        ),
    )
    return SimpleNamespace(transforms=[stamped])


@pytest.fixture
def tree() -> TransformTree:
    tree = TransformTree()
    for parent, child, t, q in (
        ("base", "mast", (0.4, 0.3, 0.9), (0.1, -0.2, 0.3, 0.927361849549570)),
        ("mast", "camera", (0.0, 0.1, 0.25), (-0.5, 0.5, -0.5, 0.5)),
        ("/base", "/lidar", (-0.2, 0.0, 1.3), (0.9, 0.1, -0.4, -0.141421356237309)),
    ):
        tree.add(tf(parent, child, t, q), static=True)
    for t, q, stamp_ns in (
        ((1.1, 2.1, 0.1), (0.0, 0.1, -0.6, -0.793725393319377), 1_033_333_333),
        ((1.0, 2.0, 0.1), (0.0, 0.0, 0.6, 0.8), 1_000_000_000),
    ):
        tree.add(tf("odom", "base", t, q, stamp_ns), static=False)
    return tree


# What tf2_ros.Buffer of geometry2 (branch jazzy, compiled by g++ 12 on x86-64) answers for the tree
# above: translation x y z, rotation x y z w.
OF_TF2 = [
    ("base", "camera", None,
     ("0x1.0ceccf10c8f41p-2 0x1.36eb486353472p-2 0x1.21ad1468c1667p+0 "
     "-0x1.dacf2c1ebf387p-2 0x1.0e025f51f26b9p-2 "
     "-0x1.7468c5b858d1fp-2 0x1.87012fa8f935dp-1")),
    ("camera", "base", None,
     ("0x1.4869ed381bd5cp-3 0x1.b01e32b5a6d3ep-1 -0x1.ad73f814b3092p-1 "
     "0x1.dacf2c1ebf387p-2 -0x1.0e025f51f26b9p-2 "
     "0x1.7468c5b858d1fp-2 0x1.87012fa8f935dp-1")),
    ("lidar", "camera", None,
     ("0x1.058f26dd8371ap-1 -0x1.95c243c5db8c6p-3 -0x1.7b9ed7defea10p-3 "
     "0x1.61b62338b334cp-1 0x1.40bd30c22726cp-1 "
     "-0x1.2bec9be4333f4p-4 0x1.69f4de5ba11bep-2")),
    ("odom", "camera", 1012345678,
     ("0x1.80895f396d818p-1 0x1.295b1a30633a5p+1 0x1.3aff8e8fc4167p+0 "
     "-0x1.07c9073ebeb0dp-1 -0x1.8a5ebbfb2411dp-4 "
     "0x1.357831c718c02p-3 0x1.ad1f2ce418002p-1")),
    ("camera", "odom", 1000000000,
     ("-0x1.771824254abc0p+0 0x1.7d056681c9c84p-2 -0x1.26d2a236d665ep+1 "
     "0x1.0eed2e3e7b9d5p-1 0x1.138338dd2995dp-4 "
     "-0x1.568e693b6197dp-3 0x1.a886c7d81536dp-1")),
    ("odom", "base", None,
     ("0x1.199999999999ap+0 0x1.0cccccccccccdp+1 0x1.999999999999ap-4 "
     "0x0.0p+0 -0x1.999999999999cp-4 "
     "0x1.3333333333334p-1 0x1.96632cbc9f77ep-1")),
]  # fmt: skip


@pytest.mark.parametrize(("target", "source", "stamp_ns", "text"), OF_TF2)
def test_the_same_as_tf2(tree, target, source, stamp_ns, text):
    x, y, z, *quaternion = map(float.fromhex, text.split())
    expected = from_numbers((x, y, z), tuple(quaternion))
    found = tree.lookup(target, source, stamp_ns)
    assert np.allclose(found.translation, expected.translation, rtol=0.0, atol=1e-14)
    assert np.allclose(found.rotation, expected.rotation, rtol=0.0, atol=1e-14)


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
        (tf("a", "b", (NAN, 0.0, 0.0), NO_TURN), r"usable .*'b' in 'a' on TF the tr.*not finite"),
        (tf("a", "/b", (0.0, 0.0, 0.0), (0.0,) * 4), r"usable .* the quat.* is not a rotation"),
        (tf("a", "b", (0.0, 0.0, 0.0), (NAN,) * 4), r"usable .* \(nan, nan, .* is not a rotation"),
        (tf("a", "b", (0.0, 0.0, 0.0), (0.0, 0.0, 0.1, 1.1)), "usable .* is not a rotation"),
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
