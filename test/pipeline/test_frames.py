# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""From message to pose: refusals and their reasons, times, changes of camera and settings."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer.pipeline.frames
from rs_localizer.config import LocalizerConfig, NodeConfig, PoseTime, VelocityPrior
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Reason
from rs_localizer.core.rig import Rig
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.core.shutter import Motion
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.prior import Prior
from rs_localizer.io.calibration import lens_parameters
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.messages import MessageError
from rs_localizer.io.outputs import Localized
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.tools.simulation.frames import simulate_frames
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.settings import FrameSettings
from rs_localizer.tools.simulation.true_motion import ConstantVelocity

from .clouds import cloud_of

FIELDS = [(name, 8 * i, 8) for i, name in enumerate("xyzuv")]
READOUT_TIME = 0.03
MOTION = Motion(
    rotation=Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(),
    translation=np.array([0.1, -0.2, 2.0]),
    angular_velocity=np.array([0.05, -0.1, 0.2]),
    linear_velocity=np.array([0.02, 0.05, -0.01]),
)


class MockLocalizer(Localizer):
    """Knows one motion, keeps every second point, and remembers how it was made."""

    made: list["MockLocalizer"]

    def __init__(self, camera: Camera, config: LocalizerConfig) -> None:
        if config.solver == "r9p":
            raise ValueError("nine are too many")
        self.rig, self.config = Rig.of(camera), config
        self.priors: list[Prior | None] = []
        MockLocalizer.made.append(self)

    def warm_up(self) -> None:
        pass

    def accepted(self, found: Estimate | Failure) -> Estimate | Failure:
        return found

    def find(self, *given: Any, **more: Any) -> Estimate | Failure:
        return self.localize(*given, **more)

    def known_of(self, *given: Any) -> Any:
        raise np.linalg.LinAlgError("each frame stands alone: its motion is what it is")

    def localize(
        self,
        points: Array,
        pixels: Array,
        scores: Array | None = None,
        prior: Prior | None = None,
        expected_share: float = 0.5,
        turn: object = None,
        stamps: object = None,
        error_modes: object = None,
    ) -> Estimate | Failure:
        self.priors.append(prior)
        if len(points) < 4:
            return Failure(Reason.TOO_FEW_POINTS, f"{len(points)} points")
        return Estimate(
            rotation=MOTION.rotation,
            translation=MOTION.translation,
            angular_velocity=MOTION.angular_velocity,
            linear_velocity=MOTION.linear_velocity,
            inliers=np.arange(len(points)) % 2 == 0,
            residuals=pixels[:, 0] - 100.0,
            joint_covariance=np.eye(18),
            global_shutter_inliers=4,
            iterations=10,
            span=self.camera.readout_time,
        )


@pytest.fixture
def mock(monkeypatch) -> type[MockLocalizer]:
    MockLocalizer.made = []
    monkeypatch.setattr(rs_localizer.pipeline.frames, "Localizer", MockLocalizer)
    return MockLocalizer


@pytest.fixture
def cloud(make_cloud_message) -> SimpleNamespace:
    rows = [[i, i, i, 100.0 + i, 200.0] for i in range(8)]
    return make_cloud_message(rows, FIELDS, point_step=40, stamp=(5, 0))


def again(cloud: SimpleNamespace) -> SimpleNamespace:
    """The same points a frame later."""
    cloud.header.stamp.nanosec += 33_000_000
    return cloud


def localized(result: Localized | Refusal) -> Localized:
    assert result, result
    return result


def refused(result: Localized | Refusal) -> tuple[str, str]:
    assert isinstance(result, Refusal)
    assert not result
    return result.reason, result.detail


@pytest.mark.usefixtures("mock")
def test_reasons_of_refusals(cloud, make_camera_info):
    frames = FrameLocalizer(NodeConfig())
    assert refused(frames.localize(again(cloud)))[0] == "no_camera_info"
    with pytest.raises(MessageError, match="not calibrated"):
        frames.calibrate(read_camera_info(make_camera_info(k=np.zeros(9))))
    assert refused(frames.localize(again(cloud)))[0] == "no_camera_info"
    frames.calibrate(read_camera_info(make_camera_info()))
    assert localized(frames.localize(again(cloud))).map_frame == "map"
    cloud.width = 3
    assert refused(frames.localize(again(cloud))) == ("too_few_points", "3 points")
    cloud.width = 0
    reason, detail = refused(frames.localize(again(cloud)))
    assert reason == "empty_cloud"
    assert "width 0" in detail
    cloud.width = 9
    reason, detail = refused(frames.localize(again(cloud)))
    assert reason == "bad_cloud"
    assert "truncated" in detail
    # A refused frame leaves no trace.
    cloud.width = 8
    assert localized(frames.localize(again(cloud))).body_frame == "camera"


@pytest.mark.usefixtures("mock")
def test_inliers_are_the_rows_that_were_kept(make_cloud_message, make_camera_info):
    rows = [[i, i, i, 100.0 + i, 200.0] for i in range(8)]
    rows[0][1] = rows[3][4] = float("nan")
    frames = FrameLocalizer(NodeConfig())
    frames.calibrate(read_camera_info(make_camera_info()))
    message = make_cloud_message(rows, FIELDS, point_step=40)
    frame = localized(frames.localize(message))
    assert frame.dropped == 2
    # Of 1, 2, 4, 5, 6, 7 every second one.
    assert frame.inliers["x"].tolist() == [1.0, 4.0, 6.0]
    assert frame.inliers["residual"].tolist() == [1.0, 4.0, 6.0]


@pytest.mark.usefixtures("mock")
@pytest.mark.parametrize("pose_time", list(PoseTime))
def test_without_a_readout_time_there_is_a_pose_but_no_twist(cloud, make_camera_info, pose_time):
    frames = FrameLocalizer(NodeConfig(stamp_offset=0.5, pose_time=pose_time))
    frames.calibrate(read_camera_info(make_camera_info()))
    frame = localized(frames.localize(cloud))
    assert frame.twist is None
    # Row times need no readout time: the stamp is that of the first row.
    tau, delay = (-0.5, 0) if pose_time == PoseTime.STAMP else (0.0, 500_000_000)
    assert frame.stamp_ns == 5_000_000_000 + delay
    rotation, translation = MOTION.at(tau)
    assert np.allclose(frame.pose.rotation, rotation.T)
    assert np.allclose(frame.pose.position, -rotation.T @ translation)


def test_a_new_camera_counts_from_the_next_frame_on(cloud, make_camera_info, mock):
    notices: list[tuple[str, str]] = []
    frames = FrameLocalizer(
        NodeConfig(readout_time=READOUT_TIME, scan_direction="left_to_right"),
        lambda *words: notices.append(words),
    )
    frames.calibrate(read_camera_info(make_camera_info()))
    made = len(mock.made)
    frames.calibrate(read_camera_info(make_camera_info()))  # the same again
    assert len(mock.made) == made
    assert notices == []
    other = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="right_eye")
    frames.calibrate(read_camera_info(make_camera_info(header=other, width=320)))
    assert [name for name, _ in notices] == ["camera_changed"]
    assert "to 'right_eye', 320 x 480" in notices[0][1]
    assert mock.made[-1].camera.width == 320
    assert mock.made[-1].camera.readout_time == READOUT_TIME
    assert mock.made[-1].camera.scan_direction == "left_to_right"
    assert localized(frames.localize(again(cloud))).body_frame == "right_eye"
    with pytest.raises(MessageError):
        frames.calibrate(read_camera_info(make_camera_info(height=0)))
    assert localized(frames.localize(again(cloud))).body_frame == "right_eye"


def simulated(direction: str, **settings: Any) -> list[tuple[Any, Any]]:
    """Messages and truth of frames of a fast camera, without noise."""
    camera = Camera(
        640,
        480,
        np.array([[500.0, 0.0, 319.5], [0.0, 510.0, 239.5], [0.0, 0.0, 1.0]]),
        readout_time=READOUT_TIME,
        scan_direction=direction,
    )
    motion = ConstantVelocity(np.array([1.0, -2.0, 3.0]), np.array([1.0, 0.5, -1.5]), 0.3)
    world = room(np.zeros((1, 3)), np.random.default_rng(0), count=5000)
    clean = FrameSettings(points=150, noise=0.0, outliers=0.0)
    frames = simulate_frames(camera, motion, world, clean)
    return [(cloud_of(frame.stamp_ns, frame.points, frame.pixels), motion) for frame in frames]


@pytest.mark.parametrize("pose_time", list(PoseTime))
@pytest.mark.parametrize("direction", list(ScanDirection))
def test_signs_and_frames_against_the_true_motion(make_camera_info, direction, pose_time):
    """The real localizer on simulated messages; velocities by differences of true poses."""
    frames = FrameLocalizer(
        # Exact pixels count as good to a hundredth, beside which the usual prior weighs something.
        NodeConfig(
            readout_time=READOUT_TIME,
            scan_direction=direction,
            pose_time=pose_time,
            velocity_prior=VelocityPrior(0.0, 0.0),
        )
    )
    frames.calibrate(read_camera_info(make_camera_info()))
    for message, motion in simulated(direction)[:4]:
        frame = localized(frames.localize(message))
        delay = 0 if pose_time == PoseTime.STAMP else 15_000_000
        assert frame.stamp_ns == frame.input_stamp_ns + delay
        step = 1e-4
        truth = motion.state(frame.stamp_ns, np.array([-step, 0.0, step]))
        before, now, after = truth.rotations
        assert np.allclose(frame.pose.rotation, now, atol=1e-9)
        assert np.allclose(frame.pose.position, truth.positions[1], atol=1e-9)
        linear = now.T @ (truth.positions[2] - truth.positions[0]) / (2 * step)
        angular = Rotation.from_matrix(before.T @ after).as_rotvec() / (2 * step)
        assert frame.twist is not None
        assert np.allclose(frame.twist.linear, linear, atol=1e-6)
        assert np.allclose(frame.twist.angular, angular, atol=1e-6)


def test_the_lens_of_a_camera_file_takes_the_place_of_camera_info(tmp_path, make_camera_info):
    file, K = tmp_path / "camera.yaml", np.array([[400.0, 0, 319], [0, 400, 239], [0, 0, 1]])
    file.write_text("/**:\n  ros__parameters:\n" + lens_parameters(Camera(640, 480, K)))
    frames = FrameLocalizer(NodeConfig(camera_file=str(file)))
    frames.load_files()
    frames.calibrate(read_camera_info(make_camera_info(width=640, height=480)))
    assert tuple(K.ravel()) == frames.calibrations[""].K
    binned = make_camera_info(width=640, height=480, k=np.zeros(9), binning_x=2, binning_y=2)
    frames.calibrate(read_camera_info(binned))  # a driver that knows no lens
    assert frames.calibrations[""].binning == (2, 2)
    assert tuple(K.ravel()) == frames.calibrations[""].K
    with pytest.raises(MessageError, match="camera_file is of an image of 640x480, camera_info of"):
        frames.calibrate(read_camera_info(make_camera_info(width=320)))
