# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of one camera: correspondences, keypoints by a map, or tags of another detector."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rs_localizer.config import NodeConfig
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Notice, Reason
from rs_localizer.core.shake import within_rows
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.prior import Prior
from rs_localizer.io.clouds import Correspondences, Keypoints, read_correspondences, read_keypoints
from rs_localizer.io.outputs import Localized
from rs_localizer.io.transforms import Transforms
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline import what_fits
from rs_localizer.pipeline.aid import Moment, aid_of
from rs_localizer.pipeline.cloud_checks import moved_landmarks, stale_landmarks
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.given_pose import GivenPose, PosePrior
from rs_localizer.pipeline.pose_at_time import PublishedMoment, middle_row_ns, published_moment
from rs_localizer.pipeline.refusal import Notify, Refusal, read_or_refuse, unheard
from rs_localizer.tracking import FrameContext, Tracker

if TYPE_CHECKING:
    from rs_localizer.pipeline.tags import Tags

# From this chance on of a wrong pose or map, it is more probable than not.
DOUBTFUL = 0.5


class CameraFrames(FrameLocalizer):
    """Localizes the frames of one camera, without a name; see :class:`FrameLocalizer`."""

    def __init__(
        self, config: NodeConfig, notice: Notify = unheard, transforms: Transforms | None = None
    ) -> None:
        self._tags: Tags | None = None
        self._pose_prior = PosePrior(notice)
        super().__init__(config, notice, transforms)

    def load_files(self) -> None:
        """Use ``camera_file``, ``map_file`` and ``marker_map`` of the settings, if any."""
        super().load_files()
        if self.config.marker_map:  # others need no detector
            from rs_localizer.markers.map_files import read_marker_map
            from rs_localizer.pipeline.tags import Tags

            marker_map = read_marker_map(Path(self.config.marker_map).expanduser())
            self._tags = Tags(marker_map, self._notice)

    @property
    def map_points(self) -> Array | None:
        return super().map_points if self._tags is None else self._tags.corners

    def give_pose(self, given: GivenPose) -> None:
        """Find the next frame near this pose; one that a user gives ends the track."""
        self._pose_prior.given = given
        if not given.lasts:
            self._forget_motion()

    def _new_tracker(self, config: NodeConfig, cameras: Mapping[str, Camera]) -> Tracker:
        (camera,) = cameras.values()
        timed = config.is_timed
        tracks = config.tracking and timed
        aid = aid_of(config, camera) if timed else None
        lag = config.output_lag if tracks else 0
        return Tracker(Localizer(camera, config), aid, tracks, lag, config.max_prediction)

    def _forget_frames(self) -> None:
        # Of the last frames, by time of the middle row: with what their results are published.
        self._waiting: dict[int, tuple[Correspondences, PublishedMoment]] = {}
        # The newest of them that has a pose, without its rows.
        self._newest: Correspondences | None = None
        self._faults: set[str] = set()  # of the shutter, which have been noticed

    @property
    def camera(self) -> Camera:
        """The camera, by the latest calibration and settings."""
        return self._cameras[""]

    @property
    def _context(self) -> FrameContext:
        """Knowledge of the next frame."""
        return FrameContext(self.config.readout_time_deviation, self.landmarks.error_modes)

    def _middle_row_ns(self, stamp_ns: int) -> int:
        """Return the time at which the middle row of the image with this stamp was exposed."""
        return middle_row_ns(self.config, self.camera, stamp_ns)

    def awaits_readings(self, stamp_ns: int, patience: float) -> bool:
        """Return True if readings of the frame with this stamp may come within so many seconds."""
        return self.aid.awaits(self._moment(self._middle_row_ns(stamp_ns)), patience)

    def _moment(self, time_ns: int) -> Moment:
        """Return what readings at a time are for."""
        return Moment(self.tracker, self.config, time_ns, self.camera_frame, self.transforms)

    def localize(self, message: Any) -> Localized | Refusal | None:
        """Localize one sensor_msgs/PointCloud2 of correspondences; never raises for bad ones."""
        cloud = read_or_refuse(read_correspondences, message, Reason.BAD_CLOUD)
        return cloud if isinstance(cloud, Refusal) else self.localize_cloud(cloud)

    def localize_cloud(self, cloud: Correspondences) -> Localized | Refusal | None:
        """Localize correspondences, however they came; None: the frame waits (``output_lag``)."""
        refusal = self.stream.follow(cloud.stamp_ns, cloud.frame)
        if refusal is not None:
            return refusal
        result = self._localize(cloud)
        if result:
            self.landmarks.lacking = False  # who sends correspondences needs none
        return self._delayed(result, cloud.stamp_ns)

    def localize_keypoints(self, message: Any) -> Localized | Refusal | None:
        """Localize one sensor_msgs/PointCloud2 of keypoints; never raises for bad ones.

        Tracked, landmarks are first looked for where the motion predicts them only, then, if that
        gives no pose, all over the map.
        """
        keypoints = read_or_refuse(read_keypoints, message, Reason.BAD_KEYPOINTS)
        if isinstance(keypoints, Refusal):
            return keypoints
        if self.landmarks.map is not None:
            refusal = self.stream.follow(keypoints.stamp_ns, self.landmarks.map.frame)
            if refusal is not None:
                return refusal
        by = self.landmarks.matching_by(keypoints)
        if isinstance(by, Refusal):
            return by
        if (cloud := self.landmarks.repeated(keypoints)) is not None:
            return self._delayed(self._localize(cloud), keypoints.stamp_ns)
        if by == "descriptor":
            time_ns = self._middle_row_ns(keypoints.stamp_ns)
            if self.landmarks.map is not None:
                self._expect(time_ns, self.landmarks.map.frame)
            if (prior := self.tracker.prediction(time_ns, context=self._context)) is not None:
                result = self._localize_by_map(keypoints, prior)
                # Without its mounting a pose is none the worse.
                if result or result.reason is Reason.NO_TRANSFORM:
                    return self._delayed(result, keypoints.stamp_ns)
        return self._delayed(self._localize_by_map(keypoints, None), keypoints.stamp_ns)

    def localize_detections(self, message: Any) -> Localized | Refusal | None:
        """Localize one AprilTagDetectionArray by ``marker_map``; never raises for bad ones."""
        if self._tags is None:
            return Refusal(Reason.NO_MAP, "detections need the setting marker_map")
        cloud = self._tags.match(message)
        return cloud if isinstance(cloud, Refusal) else self.localize_cloud(cloud)

    def _localize_by_map(self, keypoints: Keypoints, prior: Prior | None) -> Localized | Refusal:
        cloud = self.landmarks.match(keypoints, self.camera, prior)
        return cloud if isinstance(cloud, Refusal) else self._localize(cloud)

    def _localize(self, cloud: Correspondences) -> Localized | Refusal:
        if not self.calibrations:
            return Refusal(Reason.NO_CAMERA_INFO, "no usable camera_info has come yet")
        cloud = self._checked(cloud)
        time_ns, context = self._middle_row_ns(cloud.stamp_ns), self._context
        self._expect(time_ns, cloud.frame)
        moment = published_moment(self.config, self.camera, cloud.stamp_ns)
        tracker, frame = self.tracker, self._moment(time_ns)
        readings = self.aid.readings(frame)
        tracker.localize(
            time_ns, cloud.points, cloud.pixels, cloud.scores, readings=readings, context=context
        )
        result = tracker.newest
        assert result is not None
        self.aid.judge(frame, readings, result)
        shown = moment.tau == within_rows(moment.tau) or tracker.repeats
        if result and result.aided and not shown:  # the readings, and no row, show its motion
            moment = moment._replace(motion=tracker.turned(moment.stamp_ns, readings))
        if result:
            if tracker.pace.fault:
                self._notice(tracker.pace.notice, tracker.pace.fault)
            self._pose_prior.judge_result(result)
            if self.predicts:
                self._newest = replace(cloud, table=cloud.table[:0], dropped=0)
        if tracker.output_lag > 0:
            self._waiting[time_ns] = cloud, moment
            while len(self._waiting) > tracker.output_lag + 1:
                del self._waiting[next(iter(self._waiting))]
        if (shutter := tracker.shutter).fault and shutter.kind not in self._faults:
            self._faults.add(shutter.kind)
            self._notice(Notice.READOUT_TIME, shutter.fault)
        published = self._published(cloud, result, moment)
        if tracker.repeats and result:
            self._notice(
                Notice.STILL_IMAGE,
                "the pixels are those of the last image, bit for bit, and nothing says that the "
                "camera moves: it counts once",
            )
        return self._mistakes.explained(
            published,
            lambda: what_fits.what_fits(tracker.localizer, cloud.points, cloud.pixels),
        )

    def _expect(self, time_ns: int, map_frame: str) -> None:
        """Tell the tracker what others know of the pose at a time, if it knows nothing itself."""
        if not (self.calibrations and self._pose_prior.given):
            return
        if self.tracker.prediction(time_ns) is not None:
            return
        prior = self._pose_prior.prior(self._moment(time_ns), map_frame)
        if prior is not None:
            self.tracker.expect(time_ns, prior)

    def _published(
        self, cloud: Correspondences, result: Estimate | Failure, moment: PublishedMoment
    ) -> Localized | Refusal:
        """Return a result of the body at the published moment."""
        # A part of the map that lies elsewhere leaves smooth errors, too.
        if self.tracker.lens.fault and not (self.tracker.pace.is_odd or self.tracker.moved):
            self._notice(Notice.LENS, self.tracker.lens.fault)
        if not result:
            return Refusal(result.reason, result.detail)
        if result.integrity > DOUBTFUL:
            text = f"pose or map are wrong with a probability of {result.integrity:.0%}"
            self._notice(Notice.DOUBTFUL, text)
        elif not self.tracker.pace.is_odd:  # which also looks like a moved part of the map
            names = () if self._tags is None else self._tags.names
            gone = stale_landmarks(cloud, self.tracker.stale(cloud.points), names)
            moved = moved_landmarks(cloud, self.tracker.moved, names)
            for said in filter(None, (gone, moved)):
                self._notice(Notice.STALE_LANDMARKS, said)
        if result.left_out:
            self._notice(Notice.DOUBTFUL, result.left_out)
        return self._result(cloud, result, moment)

    def _delayed(self, newest: Localized | Refusal, stamp_ns: int) -> Localized | Refusal | None:
        """Return the result that ``output_lag`` asks for, once the frame of this stamp has come.

        None while the first frames wait.
        """
        tracker = self.tracker
        if tracker.output_lag == 0 or tracker.newest_ns != self._middle_row_ns(stamp_ns):
            return newest
        found = tracker.delayed
        waits = not found and found.reason is Reason.AWAITS_FRAMES
        return None if waits else self._late(found)

    def _late(self, found: Estimate | Failure) -> Localized | Refusal:
        """Return the result of a frame that has waited."""
        if not found:
            return Refusal(found.reason, found.detail)
        cloud, moment = self._waiting[found.time_ns]
        return self._published(cloud, found, moment)

    def flush(self) -> list[Localized | Refusal]:
        """Return the results of frames that still wait for others: none will come."""
        return list(map(self._late, self.tracker.flush()))

    @property
    def predicts(self) -> bool:
        """True if frames are tracked, so that :meth:`at` knows the motion between them."""
        return self.tracker.remembers_motion

    def snapshot(self) -> CameraFrames:
        """Return a copy for :meth:`at` in another thread, while frames are localized here."""
        there = copy(self)
        there.tracker = self.tracker.snapshot()
        return there

    def at(self, stamp_ns: int) -> Localized | Refusal | None:
        """Return pose and twist at a time of the images' clock, without inliers.

        None before the last frames, more than ``max_prediction`` after them, and where frames do
        not know how the camera moves (:attr:`predicts`).
        """
        if not self.predicts or self._newest is None:
            return None
        newest_ns, samples = self.tracker.newest_ns, None
        if newest_ns is not None and stamp_ns > newest_ns:
            samples = self.aid.ahead(self._moment(stamp_ns))
        found = self.tracker.at(stamp_ns, samples)
        if found is None:
            return None
        cloud = replace(self._newest, stamp_ns=stamp_ns)
        return self._result(cloud, found, PublishedMoment(stamp_ns, 0.0))
