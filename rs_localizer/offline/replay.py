"""Offline replay: the frames of a recording, one after the other, through the node's own code."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from rs_localizer.config import NodeConfig, PublishTf
from rs_localizer.io.bags import BagError, BagReader, make_message
from rs_localizer.io.messages import MessageError, stamp_ns
from rs_localizer.io.outputs import Frame
from rs_localizer.io.transforms.rigid import TransformError
from rs_localizer.io.transforms.tree import TransformTree
from rs_localizer.offline.imu_first import LOOK_AHEAD, imu_first
from rs_localizer.pipeline.frames import FrameLocalizer, Refusal

_INPUTS = {
    "correspondences": "sensor_msgs/msg/PointCloud2",
    "keypoints": "sensor_msgs/msg/PointCloud2",
    "map_points": "sensor_msgs/msg/PointCloud2",
    "camera_info": "sensor_msgs/msg/CameraInfo",
    "imu": "sensor_msgs/msg/Imu",
}
# Reasons of messages that are no frames.
NO_FRAMES = ("bad_camera_info", "bad_map", "bad_imu")

TF_TYPE = "tf2_msgs/msg/TFMessage"
_OLD_TF_TYPE = "tf/msg/tfMessage"  # of ROS 1 before tf2
CARRIED_TYPES = (TF_TYPE, _OLD_TF_TYPE, _INPUTS["imu"])
"""Types of topics that a recording made from another one keeps, because replay may need them."""


@dataclass(frozen=True, slots=True)
class Topics:
    """Where a recording has the inputs of the node: frames are correspondences or keypoints."""

    camera_info: str
    correspondences: str | None
    keypoints: str | None = None
    map_points: str | None = None

    @property
    def frames(self) -> str:
        """The topic whose messages are localized."""
        return self.correspondences or self.keypoints or ""

    @property
    def names(self) -> tuple[str, ...]:
        """All of them."""
        all_of_them = (self.camera_info, self.map_points, self.correspondences, self.keypoints)
        return tuple(name for name in all_of_them if name is not None)


def find_topics(
    bag: BagReader,
    correspondences: str | None = None,
    camera_info: str | None = None,
    keypoints: str | None = None,
    map_points: str | None = None,
) -> Topics:
    """The topics of the inputs, given or found.

    Found are those that end in the node's own names, else the only one of the type.

    Raises:
        BagError: when a given topic is not there, or none or several could be meant.
    """
    camera = _find(bag, "camera_info", camera_info)
    if correspondences is None and keypoints is None:
        found = [name for name in ("correspondences", "keypoints") if _named(bag, name)]
        if len(found) == 2:
            raise BagError(
                f"{bag.path} has correspondences and keypoints; choose with --correspondences or "
                "--keypoints"
            )
        if found == ["keypoints"]:
            keypoints = _find(bag, "keypoints", None)
    if keypoints is None:
        return Topics(camera, _find(bag, "correspondences", correspondences))
    if map_points is not None or _named(bag, "map_points"):
        map_points = _find(bag, "map_points", map_points)
    return Topics(camera, None, _find(bag, "keypoints", keypoints), map_points)


def find_imu(bag: BagReader, given: str | None = None) -> str | None:
    """The topic of the IMU: the given one, the one named imu, else the only one of its type.

    Without it, the camera goes on alone: several that could be meant are none.

    Raises:
        BagError: when a given topic is not there.
    """
    if given is not None:
        return _find(bag, "imu", given)
    named = _named(bag, "imu")
    found = named if named else imu_topics(bag)
    return found[0] if len(found) == 1 else None


def imu_topics(bag: BagReader) -> list[str]:
    """All topics of inertial measurements."""
    return sorted(topic for topic, kind in bag.topics.items() if kind == _INPUTS["imu"])


def has_frames(bag: BagReader) -> bool:
    """Whether there is anything to localize: a cloud of any kind."""
    return _INPUTS["correspondences"] in bag.topics.values()


def _named(bag: BagReader, name: str) -> list[str]:
    """Topics of the type of an input that end in its name."""
    kind = _INPUTS[name]
    return sorted(
        topic for topic in bag.topics if bag.topics[topic] == kind and topic.split("/")[-1] == name
    )


def _find(bag: BagReader, name: str, given: str | None) -> str:
    type_name = _INPUTS[name]
    of_type = sorted(topic for topic, kind in bag.topics.items() if kind == type_name)
    if given is not None:
        if given in of_type:
            return given
        found = f"is of type {bag.topics[given]}" if given in bag.topics else "does not exist"
        raise BagError(
            f"{bag.path}: topic {given} {found}; topics of type {type_name}: {_list(of_type)}"
        )
    for candidates in (_named(bag, name), of_type):
        if len(candidates) == 1:
            return candidates[0]
        if candidates:
            raise BagError(
                f"{bag.path}: several topics may be the {name}: {_list(candidates)}; "
                f"choose one with --{name.replace('_', '-')}"
            )
    raise BagError(
        f"{bag.path} has no topic of type {type_name} for the {name}; it has "
        f"{_describe(bag.topics)}"
    )


def tf_topics(bag: BagReader, *types: str) -> list[str]:
    """Those of /tf_static and /tf that the recording has, as one of these types."""
    return [topic for topic in ("/tf_static", "/tf") if bag.topics.get(topic) in types]


def as_tf2(message: Any) -> Any:
    """A message of :data:`CARRIED_TYPES`, in the type that ROS 2 has for it."""
    if message.__msgtype__ != _OLD_TF_TYPE:
        return message
    return make_message(TF_TYPE, transforms=message.transforms)


def find_transforms(
    bag: BagReader, topics: Topics, config: NodeConfig, imu: str | None = None
) -> TransformTree:
    """The transforms of the recording that the settings need; an empty tree where they need none.

    All are known from the start. A live node hears them as they come. An IMU that is not connected
    with the camera is not used.

    Args:
        bag: the recording.
        topics: of the inputs.
        config: the settings.
        imu: topic of the IMU that is to be used.

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
    camera = _frame_of(bag, topics.camera_info)
    ends = [*wanted.values()]
    if imu is not None and (imu_frame := _frame_of(bag, imu)) is not None:
        ends.append(imu_frame)
    if not ends or camera is None:
        return tree
    found = tf_topics(bag, TF_TYPE, _OLD_TF_TYPE)
    for topic in found:
        for _, _, message in bag.messages((topic,)):
            tree.add(message, static=topic == "/tf_static")
        if topic == "/tf_static" and all(_connected(tree, frame, camera) for frame in ends):
            break  # /tf is long
    for name, frame in wanted.items():
        try:
            tree.moves(frame, camera)
        except TransformError as error:
            where = " and ".join(found) or "no topic /tf_static or /tf"
            raise BagError(
                f"{bag.path} does not say where the camera {camera!r} is in {name} {frame!r}: "
                f"{error} (found {where})"
            ) from error
    return tree


def _frame_of(bag: BagReader, topic: str) -> str | None:
    """Of the first message on a topic."""
    return next((message.header.frame_id for _, _, message in bag.messages((topic,))), None)


def _connected(tree: TransformTree, target: str, source: str) -> bool:
    try:
        tree.moves(target, source)
    except TransformError:
        return False
    return True


def replay(
    bag: BagReader, topics: Topics, localizer: FrameLocalizer, imu: str | None = None
) -> Iterator[tuple[int, Frame | Refusal]]:
    """Time of recording (ns) and result of every frame, as the node would have answered.

    A CameraInfo, a map or a message of the IMU that cannot be used gives a Refusal of its own, for
    a reason of :data:`NO_FRAMES`.
    """
    frames = {
        topics.correspondences: localizer.localize,
        topics.keypoints: localizer.localize_keypoints,
    }
    others = {
        topics.camera_info: ("bad_camera_info", localizer.take_camera_info),
        topics.map_points: ("bad_map", localizer.take_map),
        imu: ("bad_imu", localizer.take_imu),
    }

    def awaits(item: tuple[str, int, Any]) -> bool:
        topic, _, message = item
        return topic in frames and localizer.awaits_imu(stamp_ns(message), LOOK_AHEAD)

    names = topics.names if imu is None else (*topics.names, imu)
    for topic, recorded_ns, message in imu_first(bag.messages(names), imu, awaits):
        if topic in frames:
            yield recorded_ns, frames[topic](message)
            continue
        reason, take = others[topic]
        try:
            take(message)
        except MessageError as error:
            yield recorded_ns, Refusal(reason, str(error))


def _list(topics: list[str]) -> str:
    return ", ".join(topics) or "none"


def _describe(topics: Mapping[str, str]) -> str:
    return ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items()))
