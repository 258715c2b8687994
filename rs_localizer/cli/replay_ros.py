"""``rs_localizer replay --ros``: a recording into the ROS graph."""

from __future__ import annotations

import importlib

from tqdm import tqdm

from rs_localizer.io.bags import BagError, BagReader
from rs_localizer.offline.image_sources import INFO_TYPE, image_topics
from rs_localizer.offline.replay import TF_TYPE, Topics, tf_topics
from rs_localizer.settings import NODE_NAME

_IMU_TYPE = "sensor_msgs/msg/Imu"


def play(bag: BagReader, topics: Topics | None, rate: float) -> None:
    """Publish the inputs of the nodes: matches or keypoints, images, their camera_info, and TF.

    Args:
        bag: the recording.
        topics: of the localizer's inputs; None: it has none, only images.
        rate: times real time.

    Raises:
        ValueError: without ROS, without anything to play, or when nobody listens.
    """
    try:  # by name: whoever has no ROS replays offline
        play = importlib.import_module("rs_localizer.ros.graph.player").play
    except ImportError as error:
        raise ValueError(
            f"--ros needs ROS 2 ({error}): source a ROS 2 workspace, or install rclpy with pip "
            "(docs/install.md)"
        ) from error
    images = image_topics(bag)
    inputs = images + (_of_type(bag, INFO_TYPE) if topics is None else list(topics.names))
    if not images and topics is None:
        raise BagError(f"{bag.path} has nothing to play: no matches, keypoints or images")
    names = tuple(dict.fromkeys((*_transforms(bag), *_of_type(bag, _IMU_TYPE), *inputs)))
    total = bag.count(names)
    latched = [] if topics is None else [t for t, item in topics.inputs.items() if item.lasting]
    played = play(
        tqdm(bag.messages(names), total=total, unit="message", desc="play", disable=None),
        {name: bag.topics[name] for name in names},
        rate,
        latched=latched,
    )
    if topics is not None:
        print(f"{bag.count([topics.frames])} frames published in {played.seconds:.1f} s")
    if images:
        print(f"{bag.count(images)} images published in {played.seconds:.1f} s")
    for topic, count in played.poses.items():
        print(f"{count} poses heard on {topic}")
    if not played.poses:
        print(f"no node {NODE_NAME} was there to publish poses")


def _of_type(bag: BagReader, type_name: str) -> list[str]:
    return sorted(topic for topic, kind in bag.topics.items() if kind == type_name)


def _transforms(bag: BagReader) -> list[str]:
    topics = tf_topics(bag, TF_TYPE)
    try:
        importlib.import_module("tf2_msgs.msg")
    except ImportError:
        if topics:
            missing = "tf2_msgs is not installed (ros-jazzy-tf2-msgs)"
            print(f"not played: {' and '.join(topics)}, {missing}")
        return []
    return topics
