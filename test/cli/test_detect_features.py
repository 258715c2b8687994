# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of anything become recordings of keypoints, the same as the node's."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from rs_localizer.cli.main import main
from rs_localizer.config import FeatureConfig
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, make_message, open_bag
from rs_localizer.io.clouds import read_keypoints
from rs_localizer.io.recording import make_camera_info
from rs_localizer.pipeline.keypoints import FrameExtractor, keypoints

K = np.array([[200.0, 0.0, 79.5], [0.0, 200.0, 59.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(160, 120, K)
NS = 10**9


def picture(seed: int) -> Any:
    noise = np.random.default_rng(seed).integers(0, 256, (120, 160), np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 2.0)


def image(ns: int, pixels: Any) -> Any:
    stamp = make_message("builtin_interfaces/msg/Time", sec=ns // NS, nanosec=ns % NS)
    header = make_message("std_msgs/msg/Header", stamp=stamp, frame_id="eye")
    return make_message(
        "sensor_msgs/msg/Image", header=header, height=120, width=160, encoding="mono8",
        is_bigendian=0, step=160, data=pixels.ravel(),
    )  # fmt: skip


@pytest.fixture
def here(tmp_path) -> SimpleNamespace:
    messages = [image((5 + k) * NS, picture(k)) for k in range(3)]
    messages.append(image(8 * NS, np.zeros((120, 160), np.uint8)))
    broken = image(9 * NS, picture(0))
    broken.data = broken.data[:7]
    with BagWriter(tmp_path / "bag") as bag:
        for message in [*messages, broken]:
            ns = message.header.stamp.sec * NS
            bag.write("/camera/camera_info", make_camera_info(CAMERA, ns, "eye"), ns)
            bag.write("/camera/image_raw", message, ns)
    return SimpleNamespace(
        bag=str(tmp_path / "bag"), out=tmp_path / "out", messages=messages, path=tmp_path
    )


def clouds(path: Path) -> list[Any]:
    with open_bag(path) as bag:
        return [message for _, _, message in bag.messages(["/keypoints"])]


@pytest.mark.parametrize(("kind", "width"), [("orb", 32), ("sift", 128)])
def test_a_bag_of_images(here, kind, width, capsys):
    words = ["--features", kind, "--max-keypoints", "40", "--out", str(here.out), "--timing"]
    assert main(["detect", here.bag, *words, "--readout-time", "0.02"]) == 0
    said = capsys.readouterr().out
    assert re.search(rf"out: 3 of 5 images, \d\d keypoints \({kind}\) each \(median\)", said)
    assert "1 images have no keypoint\n" in said
    assert "left out, the first one because the data are truncated" in said
    assert (
        f"replay {here.out} --params {here.out}/parameters.yaml --out {here.out}_poses --map MAP"
        in said
    )
    assert re.search(r"time per image: [\d.]+ ms, \d+ images/s", said)
    # As the node does it, to the last bit.
    extractor = FrameExtractor(FeatureConfig(features=kind, max_keypoints=40))
    found = clouds(here.out)
    for message, cloud in zip(here.messages, found, strict=False):
        live = keypoints(extractor.take(message), make_message)
        assert bytes(cloud.data) == bytes(live.data)
        assert repr((cloud.header, cloud.fields)) == repr((live.header, live.fields))
        read = read_keypoints(cloud)
        assert read.descriptors is not None
        assert read.descriptors.shape == (cloud.width, width)
        assert read.scores is not None
        assert 10 < len(read) <= 40
    with open_bag(here.out) as bag:
        assert bag.count(["/camera_info"]) == len(found) == 3
