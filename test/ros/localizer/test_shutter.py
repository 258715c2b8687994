# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``~/image_rect_shutter`` over live DDS, against rendered images of a global shutter."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import project_rolling
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.messages import make_header, stamp_ns
from rs_localizer.io.recording import CAMERA_FRAME, make_camera_info
from rs_localizer.offline.rectified import motion_between
from rs_localizer.ros.node.conversion import copy_message, make_message
from rs_localizer.simulation.frames import middle_stamp
from rs_localizer.simulation.planes import TexturedPlane
from rs_localizer.simulation.renderer import Renderer
from rs_localizer.simulation.true_motion import ConstantVelocity
from rs_localizer.simulation.walls import collage

READOUT = 0.03
K = np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(320, 240, K, readout_time=READOUT)
MOTION = ConstantVelocity(np.array([0.8, 1.5, -1.0]), np.array([0.8, 0.3, 0.3]), 0.3)
STAMP = MOTION.start_ns + 100_000_000
MIDDLE = middle_stamp(CAMERA, STAMP)
START = MOTION.state(STAMP, np.zeros(1))
X, Y, _ = START.rotations[0].T
CORNER = START.positions[0] + START.rotations[0] @ [-2.0, -1.5, 1.5]
WALL = TexturedPlane(CORNER, X, Y, 0.01, collage(400, 300, np.random.default_rng(0)))


def cloud() -> Any:
    """Points of the wall, where the rolling shutter sees them."""
    u, v = np.meshgrid(np.linspace(0.5, 3.5, 12), np.linspace(0.5, 2.5, 10))
    points = CORNER + np.stack([u.ravel(), v.ravel()], axis=1) @ [X, Y]
    ends = MOTION.state(MIDDLE, np.array([-0.5, 0.5]) * READOUT)
    motion = motion_between(*((ends.rotations[k], ends.positions[k]) for k in range(2)))
    pixels, _ = project_rolling(CAMERA, motion.at_rows, points)
    inside = np.isfinite(pixels).all(axis=1) & (pixels >= 0).all(axis=1)
    inside &= (pixels <= [319.0, 239.0]).all(axis=1)
    rows = np.zeros(int(inside.sum()), [(name, "<f8") for name in "xyzuv"])
    for name, column in zip("xyzuv", np.hstack([points, pixels])[inside].T, strict=True):
        rows[name] = column
    return make_cloud(make_message, STAMP, "map", rows)


def test_the_image_is_that_of_a_global_shutter(start_node, peer):
    start_node("-p", f"readout_time:={READOUT}", "-p", "image_rect_shutter:=plane")
    made: dict[str, Any] = {}
    peer.node.create_subscription(
        Image, "/rs_localizer/image_rect_shutter", lambda m: made.update({m.encoding: m}), 5
    )
    infos = peer.node.create_publisher(CameraInfo, "camera_info", 1)
    clouds = peer.node.create_publisher(PointCloud2, "correspondences", 5)
    raw = peer.node.create_publisher(Image, "image", 5)
    packed = peer.node.create_publisher(CompressedImage, "image/compressed", 5)
    others = (infos, clouds, raw, packed)
    # It may compile kernels before.
    assert peer.spin_until(lambda: all(one.get_subscription_count() for one in others), 200.0)
    rolling = Renderer(CAMERA, (WALL,)).image(MOTION, STAMP)
    still = Renderer(Camera(320, 240, K), (WALL,)).image(MOTION, MIDDLE)
    info = copy_message(make_camera_info(CAMERA, STAMP), "sensor_msgs/msg/CameraInfo")
    header = make_header(make_message, STAMP, CAMERA_FRAME)
    color = np.dstack([rolling, rolling // 2, 255 - rolling])
    messages = {
        "rgb8": (
            raw,
            make_message(
                "sensor_msgs/msg/Image", header=header, height=240, width=320, encoding="rgb8",
                is_bigendian=0, step=960, data=np.ascontiguousarray(color).ravel(),
            ),
        ),
        "mono8": (
            packed,
            make_message(
                "sensor_msgs/msg/CompressedImage", header=header, format="png",
                data=cv2.imencode(".png", rolling)[1].ravel(),
            ),
        ),
    }  # fmt: skip
    for encoding, (publisher, message) in messages.items():
        for _ in range(20):
            infos.publish(info)
            publisher.publish(message)
            clouds.publish(cloud())
            if peer.spin_until(lambda wanted=encoding: wanted in made, 1.0):
                break
        image = made[encoding]
        assert stamp_ns(image) == MIDDLE
        assert (image.width, image.height, image.header.frame_id) == (320, 240, CAMERA_FRAME)
        pixels = np.array(image.data, np.uint8).reshape(240, 320, -1)
        known = pixels.any(axis=2)
        assert 0.8 < known.mean() < 1.0
        before, after = (
            np.abs(of.astype(float) - still)[known].mean() for of in (rolling, pixels[..., 0])
        )
        assert after < 0.15 * before
        if encoding == "rgb8":
            np.testing.assert_allclose(pixels[known][:, 1], pixels[known][:, 0] // 2, atol=3)
