# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of several cameras from messages to poses: :mod:`.frames` for the setting ``cameras``.

The rig has the axes of its first camera whose ``camera_info`` has come; where the others are, TF
says, at the time of the frame. Poses are those of ``base_frame``, as of one camera.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer import matching
from rs_localizer.config import NodeConfig, PoseTime
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Notice, Reason
from rs_localizer.core.rig import ByCamera, Rig, RigEstimate
from rs_localizer.io.camera_info import Calibration
from rs_localizer.io.clouds import (
    Correspondences,
    Keypoints,
    read_correspondences,
    read_keypoints,
    select_inliers,
    thinned,
)
from rs_localizer.io.outputs import CameraShare, Localized
from rs_localizer.io.topics import CAMERA_INFO, CORRESPONDENCES, KEYPOINTS, MAP_POINTS
from rs_localizer.io.transforms import Transform, TransformError, Transforms
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline.compiling import plain_frames
from rs_localizer.pipeline.frames import ANY_CALIBRATION, FrameLocalizer, oddities
from rs_localizer.pipeline.inputs import INPUTS, Input
from rs_localizer.pipeline.pose_at_time import pose_at, twist_at
from rs_localizer.pipeline.refusal import Notify, Refusal, read_or_refuse, unheard
from rs_localizer.pipeline.rig_frames import FrameAssembler, Image
from rs_localizer.pipeline.rig_watch import RigWatch
from rs_localizer.solvers.table import find_solver
from rs_localizer.tracking import Memory, Tracker

_OWN = (CAMERA_INFO, CORRESPONDENCES, KEYPOINTS)
"""Inputs that each camera of a rig has below its name."""


def frame_localizer(
    config: NodeConfig, notice: Notify = unheard, transforms: Transforms | None = None
) -> FrameLocalizer:
    """What localizes the frames of one camera, or of a rig; see :class:`FrameLocalizer`."""
    return (RigLocalizer if config.is_rig else FrameLocalizer)(config, notice, transforms)


def last_results(localizer: FrameLocalizer) -> list[Localized | Refusal]:
    """The results of what still waits for other images, where a recording ends."""
    return localizer.flush() if isinstance(localizer, RigLocalizer) else []


def inputs_of(config: NodeConfig) -> Mapping[str, Input]:
    """All inputs by name; of a rig ``NAME/correspondences`` and so on."""
    if not config.is_rig:
        return INPUTS
    rows = {item.topic: item for item in INPUTS.values() if item.topic == MAP_POINTS}
    of_rig = [_of_camera(INPUTS[topic], name) for topic in _OWN for name in config.cameras]
    # What changes the state comes first.
    infos, frames = of_rig[: len(config.cameras)], of_rig[len(config.cameras) :]
    return {item.topic: item for item in (*infos, *rows.values(), *frames)}


def _of_camera(item: Input, name: str) -> Input:
    """An input of one camera of a rig."""

    def rig(localizer: FrameLocalizer) -> RigLocalizer:
        assert isinstance(localizer, RigLocalizer)  # whose inputs these are
        return localizer

    own = replace(item, topic=f"{name}/{item.topic}", about=f"{name}: {item.about}")
    if item.topic == CAMERA_INFO:
        return replace(
            own,
            use=lambda localizer, found: rig(localizer).calibrate_camera(name, found),
            held=lambda localizer: rig(localizer).calibrations.get(name),
        )
    return replace(
        own, use=lambda localizer, message: rig(localizer).add(name, item.topic, message)
    )


class RigLocalizer(FrameLocalizer):
    """Localizes frames of the images of several cameras.

    Args: as of :class:`FrameLocalizer`.
    """

    def __init__(
        self, config: NodeConfig, notice: Notify = unheard, transforms: Transforms | None = None
    ) -> None:
        self.calibrations: dict[str, Calibration] = {}
        self._assembler = FrameAssembler(config.cameras, config.rig.window, notice)
        self._mounts: dict[str, Transform] = {}
        self.watch = RigWatch(config, notice)
        super().__init__(config, notice, transforms)

    def _use(self, calibration: Calibration, config: NodeConfig) -> None:
        # Nothing changes if this raises.
        rig = self._rig(config, self.calibrations, self._mounts)
        rolling = find_solver(config.solver).rolling_shutter
        memory = Memory.MOTION if config.tracking and rolling else Memory.NOTHING
        self._tracker = Tracker(Localizer(rig, config), None, memory)
        if not hasattr(self, "_config") or config.rig != self._config.rig:
            self._assembler = FrameAssembler(config.cameras, config.rig.window, self._notice)
        self.watch = RigWatch(config, self._notice)
        self._config = config

    def _rig(
        self,
        config: NodeConfig,
        calibrations: Mapping[str, Calibration],
        mounts: Mapping[str, Transform],
    ) -> Rig:
        """The rig of the cameras that are known; before there is one, of any."""
        if not mounts:
            calibrations = dict.fromkeys(config.cameras, ANY_CALIBRATION)
            mounts = dict.fromkeys(config.cameras, Transform(np.eye(3), np.zeros(3)))
        of = config.of_cameras
        cameras = {
            name: calibrations[name].camera(of[name].readout_time, of[name].scan_direction)
            for name in mounts
        }
        return Rig(cameras, {name: (it.rotation, it.translation) for name, it in mounts.items()})

    @property
    def rig(self) -> Rig:
        """As far as its cameras are known."""
        return self._rig(self._config, self.calibrations, self._mounts)

    @property
    def camera_frame(self) -> str:
        """The optical frame whose axes are the rig's; empty as long as it is unknown."""
        known = (self.calibrations.get(name) for name in self._config.cameras)
        return next((calibration.frame for calibration in known if calibration), "")

    @property
    def missing(self) -> tuple[str, ...]:
        infos = tuple(f"{name}/{CAMERA_INFO}" for name in self._config.cameras)
        infos = () if self.calibrations else infos
        return (*infos, MAP_POINTS) if self._landmarks.lacking else infos

    def reset(self) -> None:
        self._assembler.reset()
        self.watch.reset()
        super().reset()

    def warm_up(self) -> None:
        plain_frames(self._tracker.localizer)
        so3.quaternion(np.eye(3))
        matching.warm_up()

    def awaits_imu(self, stamp_ns: int, patience: float) -> bool:
        return False  # a rig has none

    def calibrate_camera(self, name: str, calibration: Calibration) -> None:
        """Use this calibration of a camera from the next frame on.

        Raises:
            MessageError: for one that no camera can have; the previous stays.
        """
        before = self.calibrations.get(name)
        if calibration == before:
            return
        own = self._config.of_cameras[name]
        calibration.camera(own.readout_time, own.scan_direction)
        frame = self.camera_frame
        self.calibrations[name] = calibration
        self._mounts.pop(name, None)
        if before is None and self.camera_frame == frame:
            return  # one more
        self._mounts = {}  # relative to other axes
        if before is not None:
            self._notice(
                Notice.CAMERA_CHANGED,
                f"camera_info of {name} changed from {before.frame!r}, {before.width} x "
                f"{before.height}, to {calibration.frame!r}, {calibration.width} x "
                f"{calibration.height}; the previous frames are forgotten",
            )
        self._use(calibration, self._config)

    def add(self, name: str, kind: str, message: Any) -> Iterator[Localized | Refusal]:
        """Take an image; the results of frames that are complete, before cameras are compared."""
        if name not in self.calibrations:
            text = f"no usable camera_info of {name} has come yet"
            self._notice(Notice.NO_IMAGES, f"{name} is left out: {text}")
            yield Refusal(Reason.NO_CAMERA_INFO, text)
            return
        own = self._config.of_cameras[name]
        camera = self.calibrations[name].camera(own.readout_time, own.scan_direction)
        cloud = self._read(name, kind, message, camera)
        if isinstance(cloud, Refusal):
            yield cloud
            return
        for notice, text in oddities(cloud, camera, self.calibrations[name].frame).items():
            self._notice(notice, f"{name}: {text}")
        cloud = thinned(cloud, self._config.max_points // len(self._config.cameras), camera.size)
        start_ns = self.watch.start_ns(name, cloud.stamp_ns + round(own.stamp_offset * 1e9))
        middle_ns = start_ns - round(camera.first_row_time * own.readout_time * 1e9)
        image = Image(name, start_ns, middle_ns, cloud)
        frames = self._assembler.add(image) if self.watch.is_usable(name) else []
        for images in frames:
            yield self._localize_frame(images)
        frame = self.camera_frame
        fixed = {
            each: mount
            for each, mount in self._mounts.items()
            if not self.transforms.moves(self.calibrations[each].frame, frame)
        }
        self.watch.add(image, camera, fixed)

    def flush(self) -> list[Localized | Refusal]:
        """The results of what still waits for other images: none will come."""
        return [self._localize_frame(frame) for frame in self._assembler.flush()]

    def _read(
        self, name: str, kind: str, message: Any, camera: Camera
    ) -> Correspondences | Refusal:
        """What a camera saw of the map."""
        read: Callable[[Any], Any]
        read = read_correspondences if kind == CORRESPONDENCES else read_keypoints
        found: Correspondences | Keypoints | Refusal
        found = read_or_refuse(read, message, INPUTS[kind].refused)
        if isinstance(found, Refusal):
            return replace(found, detail=f"{name}: {found.detail}")
        if isinstance(found, Correspondences):
            return found
        by = self._landmarks.how(found, self._config.matching)
        if isinstance(by, Refusal):
            return by
        return self._landmarks.match(found, self._config.matching, camera, None)

    def _localize_frame(self, images: Sequence[Image]) -> Localized | Refusal:
        reference = images[0].cloud
        others = {image.cloud.frame for image in images} - {reference.frame}
        if others:
            return Refusal(
                Reason.BAD_CLOUD,
                f"the points of {images[0].camera} are in frame {reference.frame!r}, others in "
                f"{', '.join(map(repr, sorted(others)))}: cameras of a rig see one map",
            )
        refusal = self._stream.follow(images[0].start_ns, reference.frame)
        if refusal is not None:
            return refusal
        refusal = self._mount(images)
        images = [image for image in images if image.camera in self._mounts]
        if not images:
            assert refusal is not None
            return refusal
        # Seconds since the first image: nothing is lost of stamps since 1970.
        origin_ns = images[0].start_ns
        starts = {image.camera: 1e-9 * (image.start_ns - origin_ns) for image in images}
        matches = {image.camera: _matches(image.cloud, images) for image in images}
        self._tracker.localizer.error_modes = self._landmarks.error_modes
        result = self._tracker.localize(origin_ns, matches, stamps=starts)
        self.watch.judge(bool(result))
        if not result:
            return Refusal(result.reason, result.detail)
        assert isinstance(result, RigEstimate)
        self._landmarks.lacking = False  # who sends correspondences needs none
        return self.mounted(self._localized(images, result, origin_ns))

    def _mount(self, images: Sequence[Image]) -> Refusal | None:
        """Look up where cameras are that move; why one of this frame is not known."""
        frame, stamp_ns = self.camera_frame, images[0].cloud.stamp_ns or None
        mounts, refusal = dict(self._mounts), None
        for image in images:
            name = image.camera
            own = self.calibrations[name].frame
            try:
                if name in mounts and not self.transforms.moves(own, frame):
                    continue
                mounts[name] = self.transforms.lookup(own, frame, stamp_ns)
            except TransformError as error:
                mounts.pop(name, None)
                text = f"from {frame!r} to {own!r} of camera {name}: {error}"
                refusal = Refusal(Reason.NO_TRANSFORM, text)
                self._notice(Notice.NO_IMAGES, f"{name} is left out: no transform {text}")
        if any(mounts.get(name) is not self._mounts.get(name) for name in {*mounts, *self._mounts}):
            self._mounts = {name: mounts[name] for name in self._config.cameras if name in mounts}
            if self._mounts:
                rig = self._rig(self._config, self.calibrations, self._mounts)
                # The axes, and so what is remembered of their motion, stay the same.
                self._tracker.localizer = Localizer(rig, self._config)
        return refusal

    def _localized(self, images: Sequence[Image], result: RigEstimate, origin_ns: int) -> Localized:
        """Pose and twist of the rig's axes at the published moment."""
        config, cloud = self._config, images[0].cloud
        time_ns = origin_ns + round(1e9 * result.time)
        # What is published has stamps of that camera's clock.
        own_ns = self.watch.offset_ns(images[0].camera)
        stamp_ns = time_ns - own_ns if config.pose_time == PoseTime.MID_FRAME else cloud.stamp_ns
        tau = (stamp_ns + own_ns - time_ns) / (1e9 * result.span)  # exact for a camera alone
        moving = find_solver(config.solver).rolling_shutter
        table = _table(config.cameras, images)
        return Localized(
            input_stamp_ns=cloud.stamp_ns,
            stamp_ns=stamp_ns,
            map_frame=cloud.frame,
            body_frame=self.camera_frame,
            pose=pose_at(result, tau),
            twist=twist_at(result, tau, result.span) if moving else None,
            inliers=select_inliers(table, np.asarray(result.inliers), np.asarray(result.residuals)),
            dropped=sum(image.cloud.dropped for image in images),
            estimate=result,
            cameras=tuple(_share(image, result) for image in images),
        )


def _matches(cloud: Correspondences, images: Sequence[Image]) -> tuple[Array, ...]:
    """Points and pixels of an image; with scores, where all images have them."""
    if any(image.cloud.scores is None for image in images):
        return cloud.points, cloud.pixels
    assert cloud.scores is not None
    return cloud.points, cloud.pixels, cloud.scores


def _table(names: Sequence[str], images: Sequence[Image]) -> NDArray[Any]:
    """The rows of all images, of the fields that all have, and which of the cameras it was."""
    types = [image.cloud.table.dtype for image in images]
    fields = [name for name in types[0].names or () if all(name in (t.names or ()) for t in types)]
    kinds: list[tuple[str, Any]] = [
        (name, np.result_type(*(t[name].newbyteorder("<") for t in types))) for name in fields
    ]
    rows = np.empty(sum(len(image.cloud.table) for image in images), [*kinds, ("camera", "u1")])
    first = 0
    for image in images:
        last = first + len(image.cloud.table)
        for name in fields:
            rows[name][first:last] = image.cloud.table[name]
        rows["camera"][first:last] = names.index(image.camera)
        first = last
    return rows


def _share(image: Image, result: RigEstimate) -> CameraShare:
    name = image.camera
    assert isinstance(result.inliers, ByCamera)  # as all of a rig
    assert isinstance(result.residuals, ByCamera)
    inliers = result.inliers[name]
    kept = np.asarray(result.residuals[name][inliers])
    rms = float(np.sqrt(kept @ kept / max(len(kept), 1)))
    return CameraShare(name, len(inliers), len(kept), rms, image.start_ns)
