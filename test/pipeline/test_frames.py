# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""From message to pose: refusals and their reasons, times, changes of camera and settings."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rs_localizer import data
from rs_localizer.config import NodeConfig, PoseTime
from rs_localizer.core.camera import Camera
from rs_localizer.io.camera_files import lens_parameters
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.messages import MessageError
from rs_localizer.io.outputs import Localized
from rs_localizer.io.rigs import RigParts, mounted_lenses, node_parameters, read_camchain
from rs_localizer.io.trajectories import read_tum
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.pipeline.rig_frames import RigFrames
from rs_localizer.settings import build, camera_values, write_parameters
from rs_localizer.tools.simulation import true_motion
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import (
    FrameSettings,
    SimulatedFrame,
    simulate_frames,
)

from .clouds import cloud_of

READOUT_TIME = 0.03
K = np.array([[500.0, 0.0, 319.5], [0.0, 510.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(640, 480, K, readout_time=READOUT_TIME)
FAST = true_motion.ConstantVelocity(np.array([1.0, -2.0, 3.0]), np.array([1.0, 0.5, -1.5]), 0.3)
STILL = true_motion.ConstantVelocity(np.zeros(3), np.zeros(3), 0.1)


def localized(result: Localized | Refusal | None) -> Localized:
    assert result, result
    return result


def refused(result: Localized | Refusal | None) -> tuple[str, str]:
    assert isinstance(result, Refusal)
    assert not result
    return result.reason, result.detail


def simulated(
    direction: str = "top_to_bottom", motion: true_motion.ConstantVelocity = FAST
) -> list[SimulatedFrame]:
    camera = replace(CAMERA, scan_direction=direction)
    world = room(np.zeros((1, 3)), np.random.default_rng(0), count=5000)
    clean = FrameSettings(points=150, noise=0.0, outliers=0.0)
    return list(simulate_frames(camera, motion, world, clean))[1:]  # a stamp of 0 is none


def message_of(frame: SimulatedFrame) -> Any:
    return cloud_of(frame.stamp_ns, frame.points, frame.pixels)


@pytest.fixture
def begin(make_camera_info) -> Callable[..., tuple[CameraFrames, list[tuple[str, str]]]]:
    """Frames of a calibrated camera, and the notices that they give."""

    def begin(**settings: Any) -> tuple[CameraFrames, list[tuple[str, str]]]:
        notices: list[tuple[str, str]] = []
        config = NodeConfig(**{"readout_time": READOUT_TIME} | settings)
        frames = CameraFrames(config, lambda *words: notices.append(words))
        frames.calibrate(read_camera_info(make_camera_info()))
        return frames, notices

    return begin


def test_reasons_of_refusals(make_camera_info):
    frames = CameraFrames(NodeConfig(readout_time=READOUT_TIME))
    messages = map(message_of, simulated())
    assert refused(frames.localize(next(messages)))[0] == "no_camera_info"
    with pytest.raises(MessageError, match="not calibrated"):
        frames.calibrate(read_camera_info(make_camera_info(k=np.zeros(9))))
    assert refused(frames.localize(next(messages)))[0] == "no_camera_info"
    frames.calibrate(read_camera_info(make_camera_info()))
    assert localized(frames.localize(next(messages))).map_frame == "map"
    for width, reason, text in (
        (3, "too_few_points", "3 usable points"),
        (0, "empty_cloud", "width 0"),
        (1000, "bad_cloud", "truncated"),
    ):
        message = next(messages)
        message.width = width
        said = refused(frames.localize(message))
        assert said[0] == reason
        assert text in said[1]
    # A refused frame leaves no trace.
    assert localized(frames.localize(next(messages))).body_frame == "camera"


def test_inliers_are_the_rows_that_were_kept(begin):
    seen = simulated()[0]
    seen.points[0, 1] = seen.pixels[3, 1] = np.nan
    frame = localized(begin()[0].localize(message_of(seen)))
    assert frame.dropped == 2
    kept = np.delete(seen.points, [0, 3], axis=0)[frame.estimate.inliers]
    np.testing.assert_array_equal([frame.inliers[name] for name in "xyz"], kept.T)
    expected = frame.estimate.residuals[frame.estimate.inliers]
    np.testing.assert_allclose(frame.inliers["residual"], expected, rtol=1e-6)


@pytest.mark.parametrize("pose_time", list(PoseTime))
def test_without_a_readout_time_there_is_a_pose_but_no_twist(begin, pose_time):
    frames, _ = begin(readout_time=0.0, stamp_offset=0.5, pose_time=pose_time)
    seen = simulated(motion=STILL)[0]
    frame = localized(frames.localize(message_of(seen)))
    assert frame.twist is None
    # Row times need no readout time: the stamp is that of the first row.
    delay = 0 if pose_time == PoseTime.STAMP else 500_000_000
    assert frame.stamp_ns == seen.stamp_ns + delay
    np.testing.assert_allclose(frame.pose.position, seen.first_row.positions[0], atol=1e-6)


@pytest.mark.parametrize(("bend", "told"), [(0.0, set()), (4.0, {"lens"})])
def test_a_lens_that_is_off_is_noticed_after_half_a_second(begin, bend, told):
    frames, notices = begin()
    seen, rng = simulated(motion=STILL)[0], np.random.default_rng(1)
    away = (seen.pixels - [319.5, 239.5]) / 500.0
    bent = seen.pixels + bend * (away**2).sum(axis=1)[:, None] * away  # px
    for k in range(32):
        stamp_ns = seen.stamp_ns + k * 33_000_000
        noisy = bent + rng.normal(0.0, 0.2, bent.shape)
        localized(frames.localize(cloud_of(stamp_ns, seen.points, noisy)))
        if k < 14:
            assert notices == []
    assert {name for name, _ in notices} == told


@pytest.mark.parametrize(("unit", "told"), [(1.0, ""), (1000.0, "millimetres"), (100.0, "centi")])
def test_the_unit_of_a_map_is_named_before_its_lens(begin, unit, told):
    """By a hand: priors hold tracked poses back, and what that leaves looks like a wrong lens."""
    frames, notices = begin()
    motion = true_motion.RecordedMotion(read_tum(data.path(data.HAND_MOTION)))
    world = room(true_motion.sampled_states(motion).positions, np.random.default_rng(0), count=3000)
    stamps = [motion.intervals_ns[0][0] + round(5e9 + k * 1e9 / 30) for k in range(40)]
    seen = FrameSettings(points=80, noise=0.5, outliers=0.0)
    for frame in simulate_frames(CAMERA, motion, world, seen, stamps_ns=stamps):
        frames.localize(cloud_of(frame.stamp_ns, unit * frame.points, frame.pixels))
    named = {name for name, _ in notices}
    assert ("map_scale" in named) == bool(told)
    assert named.isdisjoint({"lens", "stale_landmarks"})
    assert all(f"is the map in {told}" in text for name, text in notices if name == "map_scale")


def test_a_new_camera_counts_from_the_next_frame_on(begin, make_camera_info):
    frames, notices = begin(scan_direction="left_to_right")
    messages = map(message_of, simulated("left_to_right"))
    frames.calibrate(read_camera_info(make_camera_info()))  # the same again
    assert localized(frames.localize(next(messages))).body_frame == "camera"
    assert notices == []
    other = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="right_eye")
    frames.calibrate(read_camera_info(make_camera_info(header=other)))
    assert [name for name, _ in notices] == ["camera_changed"]
    assert "to 'right_eye', 640 x 480" in notices[0][1]
    assert localized(frames.localize(next(messages))).body_frame == "right_eye"
    with pytest.raises(MessageError):
        frames.calibrate(read_camera_info(make_camera_info(height=0)))
    assert localized(frames.localize(next(messages))).body_frame == "right_eye"


def test_the_lens_of_a_camera_file_takes_the_place_of_camera_info(tmp_path, make_camera_info):
    file, K = tmp_path / "camera.yaml", np.array([[400.0, 0, 319], [0, 400, 239], [0, 0, 1]])
    write_parameters(file, {}, lens_parameters(Camera(640, 480, K)))
    frames = CameraFrames(NodeConfig(camera_file=str(file)))
    frames.load_files()
    frames.calibrate(read_camera_info(make_camera_info(width=640, height=480)))
    assert tuple(K.ravel()) == frames.calibrations[""].K
    binned = make_camera_info(width=640, height=480, k=np.zeros(9), binning_x=2, binning_y=2)
    frames.calibrate(read_camera_info(binned))  # a driver that knows no lens
    assert frames.calibrations[""].binning == (2, 2)
    assert tuple(K.ravel()) == frames.calibrations[""].K
    with pytest.raises(MessageError, match="camera_file is of an image of 640x480, camera_info of"):
        frames.calibrate(read_camera_info(make_camera_info(width=320)))


def test_the_lenses_of_a_rig_are_those_of_its_file(tmp_path, make_camera_info):
    file, K = tmp_path / "rig.yaml", np.array([[400.0, 0, 319], [0, 400, 239], [0, 0, 1]])
    a = Camera(640, 480, K, readout_time=0.02)
    cameras = {"a": a, "b": replace(a, K=K + np.diag([9.0, 9.0, 0.0]))}
    poses = dict.fromkeys(cameras, (np.eye(3), np.array([0.1, 0.0, 0.0])))
    parts = RigParts(cameras, poses, {"b": 0.01})
    write_parameters(file, node_parameters(parts), mounted_lenses(parts))
    assert read_camchain(file).time_offset == {"a": 0.0, "b": 0.01}
    frames = RigFrames(build({**camera_values(file), "camera_file": str(file)}))
    frames.load_files()
    for name, camera in cameras.items():
        frames.calibrate(read_camera_info(make_camera_info(width=640, height=480)), name)
        assert tuple(camera.K.ravel()) == frames.calibrations[name].K


def test_refinement_turns_off_what_knows_more_than_the_points_of_a_frame(begin):
    """However the settings come; asked for again, all of it is back."""
    wanted = NodeConfig(readout_time=READOUT_TIME, publish_tf="map_to_camera", refinement="none")
    frames, _ = begin(refinement="none")

    def told(config: NodeConfig) -> list[Localized]:
        frames.change(config)
        frames.reset()
        return [localized(frames.localize(message_of(seen))) for seen in simulated()[:2]]

    for kind, sent in (("none", "none"), ("motion", "map_to_camera")):
        for found in told(replace(wanted, refinement=kind)):
            assert frames.config.publish_tf == sent
            assert not frames.predicts
            assert not found.estimate.tracked
            assert np.isnan(found.pose.covariance).all() == (kind == "none")
            assert np.isnan(found.estimate.integrity) == (kind == "none")
    assert [it.estimate.tracked for it in told(replace(wanted, refinement="full"))] == [False, True]
    assert frames.predicts
