# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of several cameras become frames: by their stamps, however fast they come.

A frame holds one image of each camera; the middles of their exposures lie within ``rig.window``. It
is complete when all awaited cameras have come, or when an image of the next frame comes. A camera
that has been missing from some frames in a row is no longer awaited until it comes again. A notice
names images that are left out: those that come after their frame, and those of a clock that is
ahead of the others, or has gone back alone. When all clocks go back, a recording has started over.
:class:`RigFrames` localizes the frames.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rs_localizer.config import NodeConfig, PoseTime
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Notice, Reason
from rs_localizer.core.rig import ByCamera, Rig, RigEstimate
from rs_localizer.io import clouds
from rs_localizer.io.camera_info import Calibration
from rs_localizer.io.outputs import CameraShare, Localized
from rs_localizer.io.topics import CORRESPONDENCES
from rs_localizer.io.transforms import Transform, TransformError, Transforms
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline import what_fits
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.inputs import INPUTS
from rs_localizer.pipeline.pose_at_time import PublishedMoment
from rs_localizer.pipeline.refusal import Notify, Refusal, read_or_refuse, unheard
from rs_localizer.tracking import FrameContext, Tracker

# Frames in a row without a camera after which it is not awaited: it may have lost one or two.
_ABSENT = 3
# s: what is farther ahead of the last frame is of another clock, if other cameras go on from there.
_LONGEST_STEP = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class CameraImage:
    """Points that one of the cameras saw."""

    camera: str
    start_ns: int  # exposure of the first row
    middle_ns: int  # of the exposure
    cloud: clouds.Correspondences


class FrameAssembler:
    """Puts images together.

    Args:
        names: of all cameras, in the order in which a frame has them.
        window: s.
        notice: told which camera is left out, and why.
    """

    def __init__(self, names: Sequence[str], window: float, notice: Notify) -> None:
        self._names, self._window_ns = tuple(names), round(window * 1e9)
        self._notice = notice
        self.reset()

    def reset(self) -> None:
        """Forget all images so far."""
        self._waiting: dict[str, CameraImage] = {}
        self._last_ns: int | None = None  # middle of the latest image of the last frame
        self._stamps: dict[str, int] = {}  # the last of each camera
        self._missed = dict.fromkeys(self._names, 0)  # frames in a row
        self._gone_back: set[str] = set()

    def add(self, image: CameraImage) -> list[list[CameraImage]]:
        """Return the frames that are complete with this image: none, one or two."""
        if not self._is_usable(image):
            return []
        frames = []
        if not self._belongs(image):
            frames.append(self._complete())
        self._waiting[image.camera] = image
        self._missed[image.camera] = 0
        awaited = [name for name in self._names if self._missed[name] < _ABSENT]
        if all(name in self._waiting for name in awaited):
            frames.append(self._complete())
        return frames

    def flush(self) -> list[list[CameraImage]]:
        """Return the frames that are left when no more images will come."""
        return [self._complete()] if self._waiting else []

    def _belongs(self, image: CameraImage) -> bool:
        """Return True if an image belongs to the frame that waits."""
        return image.camera not in self._waiting and all(
            abs(image.middle_ns - other.middle_ns) <= self._window_ns
            for other in self._waiting.values()
        )

    def _is_usable(self, image: CameraImage) -> bool:
        """Return True if an image can belong to the frame that waits, or to the next one."""
        name, time_ns = image.camera, image.middle_ns
        before = self._stamps.get(name)
        if before is not None and time_ns < before:
            self._gone_back.add(name)
            present = {other for other in self._names if self._missed[other] < _ABSENT}
            if present <= self._gone_back:
                self.reset()
                self._stamps[name] = time_ns
                return True
            self._leave_out(name, f"its stamps went back by {(before - time_ns) * 1e-9:.3f} s")
            return False
        self._stamps[name] = time_ns
        self._gone_back.discard(name)
        waiting = [other.middle_ns for other in self._waiting.values()]
        earliest_ns = min(waiting, default=None)
        if earliest_ns is not None and time_ns < earliest_ns - self._window_ns:
            if self._is_ahead(earliest_ns) and not self._is_ahead(time_ns):
                seconds = (earliest_ns - time_ns) * 1e-9
                for other in list(self._waiting):
                    self._leave_out(other, f"its stamps are {seconds:.3f} s ahead of the others")
                self._waiting = {}
                return True
            self._leave_out(name, f"its image is {(earliest_ns - time_ns) * 1e-9:.3f} s late")
            return False
        if self._last_ns is not None and time_ns <= self._last_ns:
            self._leave_out(name, f"its image is {(self._last_ns - time_ns) * 1e-9:.3f} s late")
            return False
        return True

    def _is_ahead(self, time_ns: int) -> bool:
        return self._last_ns is not None and time_ns - self._last_ns > _LONGEST_STEP * 1e9

    def _complete(self) -> list[CameraImage]:
        """Return the frame that waits, in the order of the names."""
        frame = [self._waiting[name] for name in self._names if name in self._waiting]
        self._waiting = {}
        self._last_ns = max(image.middle_ns for image in frame)
        for name in self._names:
            self._missed[name] = (
                0 if any(i.camera == name for i in frame) else self._missed[name] + 1
            )
            if self._missed[name] >= _ABSENT:
                self._leave_out(name, f"no image in the last {self._missed[name]} frames")
        return frame

    def _leave_out(self, name: str, why: str) -> None:
        self._notice(Notice.NO_IMAGES, f"{name} is left out: {why}")


def joined(names: Sequence[str], images: Sequence[CameraImage]) -> clouds.Correspondences:
    """Join correspondences of all images, with the stamp of the first one.

    Its rows have the fields that all have, and their camera.

    Args:
        names: of all cameras of the rig.
    """
    tables = [image.cloud.table for image in images]
    fields = [
        name
        for name in tables[0].dtype.names or ()
        if all(name in (it.dtype.names or ()) for it in tables)
    ]
    columns = [np.concatenate([table[name] for table in tables]) for name in fields]
    kinds = [(name, of.dtype.newbyteorder("<")) for name, of in zip(fields, columns, strict=True)]
    places = [names.index(image.camera) for image in images]
    columns.append(np.repeat(places, [len(table) for table in tables]))
    table = clouds.make_rows([*kinds, ("camera", "u1")], columns)
    dropped = sum(image.cloud.dropped for image in images)
    return replace(images[0].cloud, table=table, dropped=dropped)


def share_of(image: CameraImage, result: RigEstimate) -> CameraShare:
    """Return the contribution of one camera to an estimate."""
    name = image.camera
    assert isinstance(result.inliers, ByCamera)  # as all of a rig
    assert isinstance(result.residuals, ByCamera)
    inliers = result.inliers[name]
    kept = np.asarray(result.residuals[name][inliers])
    rms = float(np.sqrt(kept @ kept / max(len(kept), 1)))
    return CameraShare(name, len(inliers), len(kept), rms, image.start_ns)


class RigFrames(FrameLocalizer):
    """Localizes the frames of several cameras with names; see :class:`FrameLocalizer`.

    The rig has the axes of its first camera whose ``camera_info`` has come; where the others are,
    TF says, at the time of the frame.
    """

    def __init__(
        self, config: NodeConfig, notice: Notify = unheard, transforms: Transforms | None = None
    ) -> None:
        self._assembler = FrameAssembler(config.cameras, config.rig.window, notice)
        self._mounts: dict[str, Transform] = {}  # on the first camera, where they are known
        super().__init__(config, notice, transforms)

    def _new_tracker(self, config: NodeConfig, cameras: Mapping[str, Camera]) -> Tracker:
        tracks = config.tracking and config.is_timed
        localizer = Localizer(self._mounted_cameras(cameras), config)
        return Tracker(localizer, None, tracks, max_prediction=config.max_prediction)

    def _apply_settings(self, config: NodeConfig) -> None:
        before = self.config.rig
        super()._apply_settings(config)
        if config.rig != before:
            self._assembler = FrameAssembler(config.cameras, config.rig.window, self._notice)

    def _forget_frames(self) -> None:
        pass  # what waits for other images is no previous frame

    def _mounted_cameras(self, cameras: Mapping[str, Camera]) -> Rig:
        """Return the rig of the cameras whose mounting is known; before there is one, of any."""
        mounts = self._mounts or dict.fromkeys(cameras, Transform(np.eye(3), np.zeros(3)))
        return Rig(
            {name: cameras[name] for name in mounts},
            {name: (it.rotation, it.translation) for name, it in mounts.items()},
        )

    @property
    def rig(self) -> Rig:
        """The rig of the cameras, as far as they are known."""
        return self._mounted_cameras(self._cameras)

    def reset(self) -> None:
        """Forget the previous frames."""
        self._assembler.reset()
        super().reset()

    def _use_camera(self, name: str, calibration: Calibration) -> None:
        known, axes = name in self.calibrations, self.camera_frame
        self.calibrations[name] = calibration
        self._mounts.pop(name, None)
        if known or self.camera_frame != axes:  # else it is one more of the rig
            self._mounts = {}  # relative to other axes
            self._apply_settings(self.config)

    def add(self, name: str, kind: str, message: Any) -> Iterator[Localized | Refusal]:
        """Take an image of a camera by its name; the results of frames that it completes."""
        if name not in self.calibrations:
            text = f"no usable camera_info of {name} has come yet"
            self._notice(Notice.NO_IMAGES, f"{name} is left out: {text}")
            yield Refusal(Reason.NO_CAMERA_INFO, text)
            return
        own, camera = self.config.of_cameras[name], self._cameras[name]
        cloud = self._read(name, kind, message, camera)
        if not isinstance(cloud, Refusal):
            cloud = self.stream.unset(cloud.stamp_ns) or cloud
        if isinstance(cloud, Refusal):
            yield cloud
            return
        cloud = self._checked(cloud, name)
        start_ns = cloud.stamp_ns + round(own.stamp_offset * 1e9)
        middle_ns = start_ns - round(camera.first_row_time * own.readout_time * 1e9)
        image = CameraImage(name, start_ns, middle_ns, cloud)
        for images in self._assembler.add(image):
            yield self._localize_frame(images)

    def flush(self) -> list[Localized | Refusal]:
        """Return results of images that still wait for other cameras' images: none will come."""
        return [self._localize_frame(frame) for frame in self._assembler.flush()]

    def _read(
        self, name: str, kind: str, message: Any, camera: Camera
    ) -> clouds.Correspondences | Refusal:
        """Return the correspondences of one camera's message."""
        read: Callable[[Any], Any]
        read = clouds.read_correspondences if kind == CORRESPONDENCES else clouds.read_keypoints
        found: clouds.Correspondences | clouds.Keypoints | Refusal
        found = read_or_refuse(read, message, INPUTS[kind].refused)
        if isinstance(found, Refusal):
            return replace(found, detail=f"{name}: {found.detail}")
        if isinstance(found, clouds.Correspondences):
            return found
        by = self.landmarks.matching_by(found)
        if isinstance(by, Refusal):
            return by
        return self.landmarks.match(found, camera, None)

    def _localize_frame(self, images: Sequence[CameraImage]) -> Localized | Refusal:
        reference = images[0].cloud
        others = {image.cloud.frame for image in images} - {reference.frame}
        if others:
            return Refusal(
                Reason.BAD_CLOUD,
                f"the points of {images[0].camera} are in frame {reference.frame!r}, others in "
                f"{', '.join(map(repr, sorted(others)))}: cameras of a rig see one map",
            )
        refusal = self.stream.follow(images[0].start_ns, reference.frame)
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
        parts = ["points", "pixels"]
        if all(image.cloud.scores is not None for image in images):
            parts.append("scores")
        matches = {
            image.camera: tuple(getattr(image.cloud, part) for part in parts) for image in images
        }
        context = FrameContext(error_modes=self.landmarks.error_modes)
        result = self.tracker.localize(origin_ns, matches, stamps=starts, context=context)
        if not result:
            refusal = Refusal(result.reason, result.detail)
            localizer = self.tracker.localizer
            return self._mistakes.explained(
                refusal,
                lambda: what_fits.cameras_apart(localizer, matches, starts),
                Notice.EXTRINSICS,
            )
        assert isinstance(result, RigEstimate)
        if fault := self.tracker.cameras.fault:
            self._notice(Notice.EXTRINSICS, fault)
        self.landmarks.lacking = False  # who sends correspondences needs none
        return self._localized(images, result, origin_ns)

    def _mount(self, images: Sequence[CameraImage]) -> Refusal | None:
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
            self._mounts = {name: mounts[name] for name in self.config.cameras if name in mounts}
            if self._mounts:
                self.tracker.mount(self.rig)
        return refusal

    def _localized(
        self, images: Sequence[CameraImage], result: RigEstimate, origin_ns: int
    ) -> Localized | Refusal:
        """Return the pose and twist of the body at the published moment."""
        config, first = self.config, images[0].cloud
        time_ns = origin_ns + round(1e9 * result.time)
        stamp_ns = time_ns if config.pose_time == PoseTime.MID_FRAME else first.stamp_ns
        tau = (stamp_ns - time_ns) / (1e9 * result.span)  # exact for a camera alone
        moment = PublishedMoment(stamp_ns, tau)
        made = self._result(joined(config.cameras, images), result, moment)
        shares = tuple(share_of(image, result) for image in images)
        return replace(made, cameras=shares) if made else made
