# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``replay --rerun``: what the file holds, read back, and that nothing else changes."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rs_localizer.cli.main import main
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.recording import IMAGE_TOPIC, make_image
from rs_localizer.io.trajectories import read_motions
from rs_localizer.offline import viewing as paths

chunk = pytest.importorskip("rerun.chunk", reason="needs the Rerun SDK")

SHUTTER = ["-p", "readout_time:=0.03"]
FRAMES = 7


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Path:
    """A flight with images."""
    folder = tmp_path_factory.mktemp("bags")
    words = ["--rate", "10", "--duration", "0.65", "--outliers", "0.2", "--noise", "0.5"]
    turn = ["--angular-velocity", "0", "1.2", "0.6"]
    assert main(["simulate", str(folder / "matches"), *words, *turn]) == 0
    jpeg = cv2.imencode(".jpg", np.full((480, 640), 90, np.uint8))[1].tobytes()
    with open_bag(folder / "matches") as bag, BagWriter(folder / "flight") as copy:
        for topic, recorded, message in bag.messages(tuple(bag.topics)):
            copy.write(topic, message, recorded)
            if topic == "/correspondences":
                stamp = stamp_ns(message)
                copy.write(IMAGE_TOPIC, make_image(stamp, "jpeg", jpeg), stamp)
    return folder / "flight"


@pytest.fixture(scope="module")
def shown(flight, tmp_path_factory) -> tuple[Path, dict[str, Any]]:
    """The result, and all that its file for the viewer holds, by entity."""
    out = tmp_path_factory.mktemp("out") / "seen"
    assert main(["replay", str(flight), *SHUTTER, "--out", str(out), "--rerun"]) == 0
    found: dict[str, Any] = {}
    for item in chunk.RrdReader(out / "view.rrd").stream():
        found.setdefault(item.entity_path.strip("/"), []).append(item.to_record_batch())
    return out, found


def values(found: dict[str, Any], path: str, column: str) -> list[Any]:
    """Of a component, in the order of the stamps."""
    rows = [
        (batch.column(paths.TIMELINE)[k].value, batch.column(column)[k].as_py())
        for batch in found[path]
        if column in batch.schema.names and paths.TIMELINE in batch.schema.names
        for k in range(batch.num_rows)
    ]
    return [value for _, value in sorted(rows, key=lambda row: row[0])]


def test_what_is_shown_is_the_result(flight, shown, tmp_path):
    out, found = shown
    assert main(["replay", str(flight), *SHUTTER, "--out", str(tmp_path / "plain")]) == 0
    for name in ("poses.txt", "twists.txt"):
        assert (tmp_path / "plain" / name).read_bytes() == (out / name).read_bytes()
    motions = read_motions(out)
    assert motions.twists is not None
    places = values(found, paths.BODY, "Transform3D:translation")
    np.testing.assert_allclose(np.array(places)[:, 0], motions.poses.positions, atol=1e-5)
    speeds = values(found, paths.ANGULAR, "Scalars:scalars")
    np.testing.assert_allclose(speeds, motions.twists.angular, atol=1e-5)
    (path,) = [
        batch.column("LineStrips3D:strips")[0].as_py()[0]
        for batch in found[paths.PATH]
        if "LineStrips3D:strips" in batch.schema.names
    ]
    np.testing.assert_allclose(path, motions.poses.positions, atol=1e-5)
    # Of 150 points each a fifth is wrong.
    matches = (paths.MATCHES, paths.OTHERS)
    inliers, rest = (values(found, name, "Points2D:positions") for name in matches)
    assert [len(a) + len(b) for a, b in zip(inliers, rest, strict=True)] == [150] * FRAMES
    assert all(100 < len(a) <= 121 for a in inliers)
    assert len(values(found, paths.COVARIANCE, "Ellipsoids3D:half_sizes")) == FRAMES
    assert len(values(found, paths.IMAGE, "EncodedImage:blob")) == FRAMES


def test_without_a_screen_nothing_begins(monkeypatch, flight, tmp_path, capsys):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    out = tmp_path / "out"
    assert main(["replay", str(flight), *SHUTTER, "--out", str(out), "--view"]) == 1
    assert capsys.readouterr().err == (
        "rs_localizer replay: the Rerun viewer needs a screen (DISPLAY or WAYLAND_DISPLAY); "
        "--rerun writes a file\n"
    )
    assert not out.exists()
