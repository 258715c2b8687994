# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Offline replay: the frames of a recording, one after the other, through the node's own code."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from rs_localizer.config import ImuUse, NodeConfig, PublishTf
from rs_localizer.core.arrays import Array
from rs_localizer.io.bags import BagError, BagReader, make_message
from rs_localizer.io.imu import read_imu
from rs_localizer.io.messages import MessageError, stamp_ns
from rs_localizer.io.outputs import Localized
from rs_localizer.io.topics import (
    CAMERA_INFO,
    CORRESPONDENCES,
    DETECTIONS,
    IMAGE,
    IMU,
    KEYPOINTS,
    MAP_POINTS,
    TF,
    TF_STATIC,
)
from rs_localizer.io.transforms import TransformError, TransformTree
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.inputs import (
    CAMERA_INFO_TYPE,
    IMAGE_TYPES,
    IMU_TYPE,
    INPUTS,
    Input,
    Results,
    Role,
    frame_localizer,
    input_named,
    inputs_of,
    with_role,
)
from rs_localizer.pipeline.refusal import Notify, Refusal, unheard

Item = tuple[str, int, Any]
"""Topic, time of recording in ns, message."""

LOOK_AHEAD = 1.0
"""How far the recording is read before a frame goes without its readings, in s."""


def imu_first(
    messages: Iterable[Item], imu: str | None, awaits: Callable[[Item], bool]
) -> Iterator[Item]:
    """Yield the messages in their order, except those of ``imu``, which do not wait.

    Args:
        messages: by their times of recording.
        imu: topic; None: there is none.
        awaits: whether a message that is next still needs readings. It is asked when all before it
            have been dealt with.
    """
    waiting: deque[Item] = deque()
    for item in messages:
        if item[0] == imu:
            yield item
        else:
            waiting.append(item)
        latest_ns = item[1] - round(LOOK_AHEAD * 1e9)
        while waiting and (waiting[0][1] <= latest_ns or imu is None or not awaits(waiting[0])):
            yield waiting.popleft()
    yield from waiting


# Reasons of messages that are no frames.
NO_FRAMES = tuple(item.refused for item in INPUTS.values() if item.role != Role.FRAMES)

TF_TYPE = "tf2_msgs/msg/TFMessage"
_OLD_TF_TYPE = "tf/msg/tfMessage"  # of ROS 1 before tf2
CARRIED_TYPES = (TF_TYPE, _OLD_TF_TYPE, IMU_TYPE)
"""Types of topics that a recording made from another one keeps, because replay may need them."""


@dataclass(frozen=True, slots=True)
class Topics:
    """Topics of the node's inputs in a recording: frames are correspondences or keypoints."""

    of: Mapping[str, str]  # by the input

    @property
    def frames(self) -> str:
        """The topic whose messages are localized; of a rig, that of the first camera."""
        items = self.of.items()
        return next(topic for name, topic in items if input_named(name).role == Role.FRAMES)

    @property
    def names(self) -> tuple[str, ...]:
        """All of them."""
        return tuple(self.of.values())

    def without(self, name: str) -> Topics:
        """Return the topics without that of an input."""
        return Topics({other: topic for other, topic in self.of.items() if other != name})


def find_topics(bag: BagReader, given: Mapping[str, str | None] | None = None) -> Topics:
    """Return the topics of the inputs, given (by input; None: not given) or found.

    Found are those that end in the node's own names, else the only one of the type; of what is not
    necessary, only the former. An IMU is found by its type, too; several that could be meant are
    none.

    Raises:
        BagError: when a given topic is not there, or none or several could be meant.
    """
    wanted = {name: topic for name, topic in (given or {}).items() if topic is not None}
    frames = _choose_frames(bag, wanted)
    chosen = {}
    for name, item in INPUTS.items():
        if item.role == Role.FRAMES:
            needed = item is frames
        elif item.role == Role.SAMPLES:
            found = _named(bag, item) or imu_topics(bag)
            if len(found) == 1:
                wanted.setdefault(name, found[0])
            needed = name in wanted
        else:
            # A map is of no use for frames that bring their own points.
            used = name == frames.needs or all(name != other.needs for other in INPUTS.values())
            needed = used and (item.necessary or name in wanted or bool(_named(bag, item)))
        if needed:
            chosen[name] = bag.find_topic(item.types, wanted.get(name), item.option, item.topic)
    return Topics(chosen)


def find_rig_topics(
    bag: BagReader, cameras: Sequence[str], given: Mapping[str, str | None] | None = None
) -> Topics:
    """Return the topics of a rig's cameras, which end in ``NAME/camera_info`` and so on.

    Raises:
        BagError: when a topic is given, is not there, or several could be meant.
    """
    if named := [name for name, topic in (given or {}).items() if topic and name != MAP_POINTS]:
        raise BagError(
            f"{INPUTS[named[0]].option} is for one camera; of the cameras {', '.join(cameras)} "
            "topics are found by their names"
        )
    there = camera_topics(bag, cameras)
    kinds = {next(kind for kind in own if kind != CAMERA_INFO) for own in there.values()}
    kind = kinds.pop()
    if kinds or kind == IMAGE:
        raise BagError(f"{bag.path}: all cameras need {CORRESPONDENCES}, or all {KEYPOINTS}")
    chosen = {f"{name}/{it}": there[name][it] for it in (CAMERA_INFO, kind) for name in cameras}
    map_topic = (given or {}).get(MAP_POINTS)
    if kind == KEYPOINTS and (map_topic or _named(bag, INPUTS[MAP_POINTS])):
        item = INPUTS[MAP_POINTS]
        chosen[MAP_POINTS] = bag.find_topic(item.types, map_topic, item.option, item.topic)
    return Topics(chosen)


def camera_topics(
    bag: BagReader, cameras: Sequence[str] | None = None
) -> dict[str, dict[str, str]]:
    """Return the topics of each camera of a rig by the names of their inputs.

    Args:
        cameras: names, which are prefixes of the topics; None: all cameras.

    Raises:
        BagError: when one has no camera_info or nothing to localize.
    """
    there: dict[str, dict[str, str]] = {}
    for info in sorted(topic for topic, kind in bag.topics.items() if kind == CAMERA_INFO_TYPE):
        prefix = info.rpartition("/")[0]
        own = {topic: kind for topic, kind in bag.topics.items() if topic.startswith(f"{prefix}/")}
        topics = [(name, f"{prefix}/{name}") for name in (CORRESPONDENCES, KEYPOINTS)]
        topics = [pair for pair in topics if pair[1] in own]
        topics += [(IMAGE, topic) for topic in sorted(own) if own[topic] in IMAGE_TYPES]
        if prefix and topics:
            there[prefix.rpartition("/")[2]] = {CAMERA_INFO: info, **dict(topics[:1])}
    names = list(there) if cameras is None else list(cameras)
    alone = cameras is None and len(names) < 2
    if missing := [name for name in names if name not in there] or (alone and ["another"]):
        raise BagError(
            f"{bag.path} has no camera_info beside correspondences, keypoints or images of "
            f"{', '.join(missing)}; it has those of {', '.join(there) or 'no camera'}"
        )
    return {name: there[name] for name in names}


def _choose_frames(bag: BagReader, wanted: Mapping[str, str]) -> Input:
    """Choose the input to localize: what is given, else what is there by its name."""
    kinds = with_role(Role.FRAMES)
    given = [item for item in kinds if item.topic in wanted]
    if given:
        return given[-1]
    candidates = [item for item in kinds if _named(bag, item)]
    if len(candidates) > 1:
        raise BagError(
            f"{bag.path} has {' and '.join(item.topic for item in candidates)}; choose with "
            f"{' or '.join(item.option for item in candidates)}"
        )
    return candidates[0] if candidates else kinds[0]


# Messages by which a gyroscope is told from an accelerometer: half a second at 200 Hz.
_LOOKED_AT = 100


def imu_topics(bag: BagReader) -> list[str]:
    """Return all topics of inertial messages; of several those with angular velocities.

    RealSense's driver publishes its accelerometer beside its gyroscope, in the same type.
    """
    topics = sorted(topic for topic, kind in bag.topics.items() if kind == IMU_TYPE)
    if len(topics) < 2:
        return topics
    return [topic for topic in topics if _has_rates(bag, topic)] or topics


def _has_rates(bag: BagReader, topic: str) -> bool:
    for _, _, message in islice(bag.messages([topic]), _LOOKED_AT):
        with contextlib.suppress(MessageError):
            if any(read_imu(message).angular_velocity):
                return True
    return False


def has_frames(bag: BagReader) -> bool:
    """Return True if there is anything to localize: a cloud of any kind."""
    return any(set(item.types) & set(bag.topics.values()) for item in with_role(Role.FRAMES))


def _named(bag: BagReader, item: Input) -> list[str]:
    """Return topics of the type of an input that end in its name."""
    return sorted(
        topic
        for topic, kind in bag.topics.items()
        if kind in item.types and topic.split("/")[-1] == item.topic
    )


def tf_topics(bag: BagReader, *types: str) -> list[str]:
    """Return /tf_static and /tf, as far as the recording has them, as one of these types."""
    return [topic for topic in (TF_STATIC, TF) if bag.topics.get(topic) in types]


def as_tf2(message: Any) -> Any:
    """Convert a message of :data:`CARRIED_TYPES` to the type that ROS 2 has for it."""
    if message.__msgtype__ != _OLD_TF_TYPE:
        return message
    return make_message(TF_TYPE, transforms=message.transforms)


def find_transforms(bag: BagReader, topics: Topics, config: NodeConfig) -> TransformTree:
    """Return the transforms that the settings need; an empty tree if they need none.

    All are known from the start. A live node hears them as they come. An IMU that is not connected
    with the camera is not used.

    Raises:
        BagError: when the camera's frame is not connected to ``base_frame``, or to ``odom_frame``
            for ``publish_tf: map_to_odom``.
    """
    wanted = {}
    if config.base_frame:
        wanted["base_frame"] = config.base_frame
    if config.publish_tf == PublishTf.MAP_TO_ODOM:
        wanted["odom_frame"] = config.odom_frame
    tree = TransformTree()
    infos = [topic for name, topic in topics.of.items() if input_named(name).topic == CAMERA_INFO]
    frames = [frame for topic in infos if (frame := _frame_of(bag, topic)) is not None]
    camera, others = next(iter(frames), None), frames[1:]
    for name, other in zip(config.cameras[1:], others, strict=False):
        wanted[f"camera {name}"] = other
    imu = _frame_of(bag, topics.of[IMU]) if IMU in topics.of else None
    ends = [*wanted.values(), *([] if imu is None else [imu])]
    if not ends or camera is None:
        return tree
    tf = tf_topics(bag, TF_TYPE, _OLD_TF_TYPE)
    for topic in tf:
        for _, _, message in bag.messages((topic,)):
            tree.add(message, static=topic == TF_STATIC)
        if topic == TF_STATIC:
            with contextlib.suppress(TransformError):
                for frame in ends:
                    tree.moves(frame, camera)
                break  # /tf is long
    for name, frame in wanted.items():
        try:
            tree.moves(frame, camera)
        except TransformError as error:
            where = " and ".join(tf) or "no topic /tf_static or /tf"
            raise BagError(
                f"{bag.path} does not say where the camera {camera!r} is in {name} {frame!r}: "
                f"{error} (found {where})"
            ) from error
    return tree


def _frame_of(bag: BagReader, topic: str) -> str | None:
    """Return the frame of the first message on a topic."""
    return next((message.header.frame_id for _, _, message in bag.messages((topic,))), None)


def prepare_replay(
    bag: BagReader, config: NodeConfig, given: Mapping[str, str | None] | None = None,
    notice: Notify = unheard,
) -> tuple[Topics, FrameLocalizer]:  # fmt: skip
    """Prepare the inputs of :func:`replay`: topics, and a localizer with its map.

    Args:
        given: topics, as for :func:`find_topics`.
        notice: told of what is odd.

    Raises:
        ValueError: for topics, transforms or a map that are missing or cannot be used.
    """
    if config.of_cameras:
        topics = find_rig_topics(bag, config.cameras, given)
    else:
        topics = find_topics(bag, given)
    if config.imu.use == ImuUse.NONE:
        topics = topics.without(IMU)
    needed = {input_named(name).needs for name in topics.of}
    if MAP_POINTS in needed - topics.of.keys() and not config.map_file:
        raise BagError(f"{bag.path} has {topics.frames} and no map; give one with --map")
    if DETECTIONS in topics.of and not config.marker_map:
        raise BagError(f"{bag.path} has {topics.frames}; -p marker_map:=FILE says where tags are")
    localizer = frame_localizer(config, notice, find_transforms(bag, topics, config))
    localizer.load_files()
    return topics, localizer


class Answer(NamedTuple):
    """Result of a frame."""

    recorded_ns: int
    stamp_ns: int  # of its message
    result: Localized | Refusal


def replay(bag: BagReader, topics: Topics, localizer: FrameLocalizer) -> Iterator[Answer]:
    """Yield the result of every frame, as the node would have answered.

    A message that is no frame and cannot be used gives a Refusal of its own, for a reason of
    :data:`NO_FRAMES`.
    """
    rows = inputs_of(localizer.config)
    by_topic = {topic: rows[name] for name, topic in topics.of.items()}

    def awaits(item: tuple[str, int, Any]) -> bool:
        topic, _, message = item
        return topic == topics.frames and localizer.awaits_readings(stamp_ns(message), LOOK_AHEAD)

    def answer(recorded_ns: int, message: Any, result: Localized | Refusal) -> Answer:
        if result and localizer.config.output_lag > 0:  # of a frame that has waited
            return Answer(recorded_ns, result.input_stamp_ns, result)
        return Answer(recorded_ns, stamp_ns(message), result)

    for name, topic in topics.of.items():  # which recorders may write last
        if name.endswith(CAMERA_INFO):
            first = next((message for _, _, message in bag.messages((topic,))), None)
            list(_each(by_topic[topic].take_message(localizer, first)) if first is not None else ())
    messages = imu_first(bag.messages(topics.names), topics.of.get(IMU), awaits)
    last: Item | None = None
    for last in messages:
        topic, recorded_ns, message = last
        # A stamp of 0 is a time where a recording has its message at 0, too.
        localizer.stream.zero_is_time = recorded_ns == 0
        for result in _each(by_topic[topic].take_message(localizer, message)):
            yield answer(recorded_ns, message, result)
    for result in localizer.flush():
        assert last is not None  # which waits
        yield answer(last[1], last[2], result)


def inlier_columns(frame: Localized, names: str) -> Array:
    """Return fields (k, len(names)) of the inliers of a frame."""
    return np.stack([frame.inliers[name].astype(np.float64) for name in names], axis=1)


def _each(results: Results) -> Iterable[Localized | Refusal]:
    if results is None:
        return []
    return results if isinstance(results, Iterator) else [results]
