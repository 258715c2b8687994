# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Many recordings by one command: the bytes of one process, and nothing in the way."""

import csv
import filecmp
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from rs_localizer.cli import batch as fleet
from rs_localizer.cli.main import main
from rs_localizer.offline.fleet.task import Outcome, Task, perform

pytest.importorskip("distributed", reason="needs Dask")

SHUTTER = ["-p", "readout_time:=0.03"]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory) -> list[str]:
    """Two flights of one name, and a file that is none."""
    path = tmp_path_factory.mktemp("bags")
    words = ["--rate", "10", "--duration", "0.65", "--angular-velocity", "0", "1.2", "0.6"]
    for seed, folder in enumerate(("a", "b")):
        out = str(path / folder / "flight")
        assert main(["simulate", out, *words, "--seed", str(seed)]) == 0
    (path / "notes.mcap").write_text("no recording")
    return [str(path / "a" / "flight"), str(path / "b" / "flight"), str(path / "notes.mcap")]


def rows(out: Path) -> dict[str, dict[str, str]]:
    with (out / "summary.csv").open() as file:
        return {row["folder"]: row for row in csv.DictReader(file)}


def states(out: Path) -> dict[str, str]:
    return {name: row["state"] for name, row in rows(out).items()}


def differing(one: filecmp.dircmp[str]) -> list[str]:
    """Names of all that is not the same, to the last byte, in two trees."""
    _, other, unreadable = filecmp.cmpfiles(one.left, one.right, one.common_files, shallow=False)
    below = [name for sub in one.subdirs.values() for name in differing(sub)]
    return [*one.left_only, *one.right_only, *other, *unreadable, *below]


def test_two_workers_write_the_bytes_of_one_process(recordings, tmp_path, capsys):
    words, out = ["replay", *recordings, *SHUTTER, "--workers", "2"], tmp_path / "out"
    assert main([*words, "--out", str(out)]) == 1
    said = capsys.readouterr()
    failed = f"rs_localizer replay: 1 of 3 recordings failed; {out}/summary.csv says why\n"
    assert said.err == failed
    assert "3 recordings: 2 done, 1 failed\n" in said.out
    table = rows(out)
    assert states(out) == {"a_flight": "done", "b_flight": "done", "notes": "failed"}
    assert table["a_flight"]["frames"] == table["a_flight"]["localized"] == "7"
    assert table["notes"]["reason"].startswith(f"{recordings[2]} cannot be read as a recording")
    assert (out / "summary.png").read_bytes().startswith(b"\x89PNG")
    assert "# replay: 3 recordings: 2 done, 1 failed\n" in (out / "summary.md").read_text()
    # In a process of its own: what other tests have compiled in this one may round differently.
    replay = ["replay", recordings[0], *SHUTTER, "--out", str(tmp_path / "alone")]
    subprocess.run([sys.executable, "-m", "rs_localizer", *replay], check=True, capture_output=True)
    alone = filecmp.dircmp(tmp_path / "alone", out / "a_flight")
    assert sorted(differing(alone)) == ["fleet.json", "log.txt"]
    # What is done is not done again.
    result = out / "a_flight" / "poses.txt"
    before = result.stat()
    assert main([*words[:3], *SHUTTER, "--out", str(out)]) == 0
    assert "2 of 2 recordings have been done before\n" in capsys.readouterr().out
    assert result.stat() == before


def instead(monkeypatch: pytest.MonkeyPatch, work: Callable[[Task], Outcome] | None) -> None:
    """Work in this process, without the time that a worker's start takes; None: nobody works."""
    monkeypatch.setattr(
        fleet, "perform_all", lambda tasks, where: (work(task) for task in tasks if work)
    )


def test_results_of_other_settings_are_in_the_way(recordings, tmp_path, monkeypatch, capsys):
    instead(monkeypatch, None)
    out = tmp_path / "out"
    words = ["replay", *recordings, "--out", str(out), *SHUTTER]
    (out / "a_flight").mkdir(parents=True)
    (out / "a_flight" / "mine").write_text("")
    marker = '{"identity": "another", "command": "COMMAND", "figures": {}}'
    # As ``replay out/*/ --out out --overwrite`` would replace what it reads.
    for text in ("no marker", marker.replace("COMMAND", "detect")):
        (out / "a_flight" / "fleet.json").write_text(text)
        assert main([*words, "--overwrite"]) == 1
        assert f"{out}/a_flight exists and is no result of replay" in capsys.readouterr().err
    (out / "a_flight" / "fleet.json").write_text(marker.replace("COMMAND", "replay"))
    assert main(words) == 1
    assert "a_flight is a result of other settings, another recording or another version; " in (
        capsys.readouterr().err
    )
    assert main([*words, "--overwrite"]) == 0
    assert (out / "a_flight" / "mine").exists()  # until there is a better one
    assert states(out)["b_flight"] == "not done"
    with fleet.only_one(out):
        assert main([*words, "--overwrite"]) == 1
    assert f"another command is writing into {out}; wait" in capsys.readouterr().err


def test_without_dask_one_sentence_says_what_to_install(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(fleet.importlib.util, "find_spec", lambda name: None)
    assert main(["replay", "a", "b", "--out", str(tmp_path / "out")]) == 1
    assert capsys.readouterr().err.endswith("pip install 'rs_localizer[fleet]'\n")
    assert list(tmp_path.iterdir()) == []


def test_maps_are_found_from_any_directory(recordings, tmp_path, monkeypatch):
    """A worker of a scheduler has a working directory of its own."""
    seen: list[Path] = []

    def elsewhere(task: Task) -> Outcome:
        seen.append(task.arguments.map)
        return Outcome(task.name, None, "not tried")

    instead(monkeypatch, elsewhere)
    monkeypatch.chdir(tmp_path)
    words = [recordings[0], "--workers", "1", "-p", "map_file:=map.npz", "--out", "out"]
    assert main(["replay", *words]) == 1
    assert seen == [tmp_path / "map.npz"]


def test_evaluate_finds_the_truth_of_each_by_its_name(recordings, tmp_path, monkeypatch):
    """The estimates are the truth itself; one of them has none to be compared with."""
    instead(monkeypatch, perform)
    truths, estimates, out = (tmp_path / name for name in ("truths", "estimates", "out"))
    truths.mkdir()
    for name in ("one", "two"):
        shutil.copytree(recordings[0], estimates / name)
    (truths / "one").symlink_to(recordings[0])
    words = ["evaluate", *map(str, estimates.iterdir()), "--truths", str(truths)]
    assert main([*words, "--out", str(out), "--plot", "pictures"]) == 1
    found = rows(out)
    assert found["one"]["position (m) median"] == "0"
    assert (out / "one" / "pictures" / "errors.png").is_file()
    assert "poses compared\n" in (out / "one" / "log.txt").read_text()
    assert "there is no truth of" in found["two"]["reason"]
    assert not (out / "two").exists()


def test_ctrl_c_leaves_whole_results_only_and_the_next_run_goes_on(
    recordings, tmp_path, monkeypatch, capsys
):
    """As from a terminal: every process of the group gets the signal."""
    bags = [str(tmp_path / "in" / str(k)) for k in range(3)]
    for bag in bags:
        shutil.copytree(recordings[0], bag)
    out = tmp_path / "out"
    words = ["replay", *bags, *SHUTTER, "--out", str(out), "--workers", "1"]
    running = subprocess.Popen(
        [sys.executable, "-m", "rs_localizer", *words],
        start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    while not (out / "0").exists():
        assert running.poll() is None
        time.sleep(0.01)
    os.killpg(running.pid, signal.SIGINT)
    _, errors = running.communicate(timeout=60)
    assert (running.returncode, errors) == (130, "rs_localizer replay: interrupted\n")
    found = states(out)
    done = {name for name, state in found.items() if state == "done"}
    assert {"0"} <= done
    assert {path.name for path in out.iterdir() if path.is_dir()} == done
    assert all((out / name / "fleet.json").is_file() for name in done)
    assert set(found.values()) <= {"done", "not done"}
    instead(monkeypatch, perform)
    assert main(words) == 0
    assert f"{len(done)} of 3 recordings have been done before\n" in capsys.readouterr().out
    assert set(states(out).values()) == {"done"}
