# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What replay tells its users: how good the poses are, what to do first, nothing in the way."""

import dataclasses
import re
import weakref
from pathlib import Path
from typing import Any

import pytest

import rs_localizer.cli.replay as replay_command
from rs_localizer.cli.main import main
from rs_localizer.cli.replay_result import Tally, figures, print_summary
from rs_localizer.io.outputs import Localized
from rs_localizer.trajectory.readout_equations import MeasuredReadout

FRAMES = 8
SHUTTER = ["-p", "readout_time:=0.03"]


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "flight"
    words = ["--duration", str((FRAMES + 0.5) / 30), "--noise", "1", "--outliers", "0.2"]
    assert main(["simulate", str(path), "--angular-velocity", "0", "1.2", "0.6", *words]) == 0
    return path


def test_the_summary_says_how_good_the_poses_are(flight, tmp_path, capsys):
    assert main(["replay", str(flight), "--out", str(tmp_path / "out"), *SHUTTER]) == 0
    rows = dict(line.rsplit(None, 1) for line in capsys.readouterr().out.splitlines())
    assert 0.5 < float(rows["residual of the inliers (px rms, median)"]) < 2.0
    with_rows, without = (
        int(rows[f"  inliers with a {kind} shutter"]) for kind in ("rolling", "global")
    )
    assert 12 <= without < with_rows <= int(rows["points of a frame (median)"])
    # All but the first.
    assert rows["tracked from the frame before"] == f"{(FRAMES - 1) / FRAMES:.1%}"


@pytest.mark.parametrize(
    ("name", "text"),
    [("film.mp4", "is a video"), ("one.PNG", "is an image"), ("folder", "is a folder of 2 images")],
)
def test_images_are_sent_to_detect(tmp_path, capsys, name, text):
    path = tmp_path / name
    if path.suffix:
        path.write_bytes(b"")
    else:
        path.mkdir()
        for k in range(2):
            (path / f"{k}.jpg").write_bytes(b"")
    assert main(["replay", str(path)]) == 1
    error = capsys.readouterr().err
    assert f"{path} {text}, not matches: first run: rs_localizer detect {path} --map" in error
    assert "--calibration camera.yaml" in error


def test_frames_are_written_as_they_come_and_let_go(flight, tmp_path, monkeypatch):
    """An hour of them would take gigabytes."""
    real = replay_command.replay
    alive, most = weakref.WeakSet[Localized](), 0

    class Watched(Localized):
        """That a weak reference can be to."""

    def many(*arguments: Any) -> Any:
        nonlocal most
        answer = next(iter(real(*arguments)))
        first = answer.result
        values = {item.name: getattr(first, item.name) for item in dataclasses.fields(first)}
        for k in range(300):
            frame = Watched(**values | {"stamp_ns": first.stamp_ns + k})
            alive.add(frame)
            most = max(most, len(alive))
            yield answer._replace(result=frame)

    monkeypatch.setattr(replay_command, "replay", many)
    assert main(["replay", str(flight), "--out", str(tmp_path / "out"), *SHUTTER]) == 0
    poses = (tmp_path / "out" / "poses.txt").read_text().splitlines()
    assert len([line for line in poses if not line.startswith("#")]) == 300
    assert most < 10


def test_notices_are_said_in_full_and_stand_in_the_summary(flight, tmp_path, monkeypatch, capsys):
    real = replay_command.replay
    tallies: list[Tally] = []

    def odd(bag: Any, topics: Any, localizer: Any) -> Any:
        for k, item in enumerate(real(bag, topics, localizer)):
            localizer._notice("readout_time", f"estimated readout time {k} ms differs")
            yield item
        localizer.readout_watch.measured = MeasuredReadout(0.0211, 0.0002, 50, 50.0)

    monkeypatch.setattr(replay_command, "replay", odd)
    monkeypatch.setattr(replay_command, "print_summary", both(tallies, print_summary))
    assert main(["replay", str(flight), "--out", str(tmp_path / "out"), *SHUTTER]) == 0
    said = capsys.readouterr().out
    assert re.search(rf"noticed: readout_time +{FRAMES}\n", said)
    assert f"readout_time: estimated readout time {FRAMES - 1} ms differs" in said
    columns = figures(tallies[0])
    assert columns["noticed"] == f"readout_time {FRAMES}"
    assert columns["readout time seen (ms)"] == pytest.approx(21.1)
    assert columns["its deviation (ms)"] == pytest.approx(0.2)


def both(kept: list[Tally], function: Any) -> Any:
    return lambda tally, *rest: (kept.append(tally), function(tally, *rest))
