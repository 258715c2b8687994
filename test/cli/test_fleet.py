# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Many recordings by one command: the bytes of one process, and nothing in the way."""

import csv
import dataclasses
import filecmp
import importlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from rs_localizer.cli.commands import main
from rs_localizer.offline import fleet
from rs_localizer.offline.fleet import do_all, perform_task
from rs_localizer.offline.tasks import Outcome, Task, tasks_of

SHUTTER = ["-p", "readout_time:=0.03"]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory) -> list[str]:
    """Two flights of one name, and a file that is none."""
    path = tmp_path_factory.mktemp("bags")
    words = ["--duration", "0.26", "--angular-velocity", "0", "1.2", "0.6"]
    for seed, folder in enumerate(("a", "b")):
        out = str(path / folder / "flight")
        assert main(["simulate", out, *words, "--seed", str(seed)]) == 0
    (path / "notes.mcap").write_text("no recording")
    return [str(path / "a" / "flight"), str(path / "b" / "flight"), str(path / "notes.mcap")]


def rows(out: Path) -> dict[str, dict[str, str]]:
    with (out / "summary.csv").open() as file:
        return {row["folder"]: row for row in csv.DictReader(file)}


def differing(one: filecmp.dircmp[str]) -> list[str]:
    """Names of all that is not the same, to the last byte, in two trees."""
    _, other, unreadable = filecmp.cmpfiles(one.left, one.right, one.common_files, shallow=False)
    below = [name for sub in one.subdirs.values() for name in differing(sub)]
    return [*one.left_only, *one.right_only, *other, *unreadable, *below]


def test_two_workers_write_the_bytes_of_one_process(recordings, tmp_path, capsys, ran):
    words, out = ["replay", *recordings, *SHUTTER, "--workers", "2"], tmp_path / "out"
    said = ran(*words, "--out", out, code=1)
    failed = f"rs_localizer replay: 1 of 3 recordings failed; {out}/summary.csv says why\n"
    assert said.err == failed
    table = rows(out)
    assert list(table) == ["a_flight", "b_flight", "notes"]
    assert table["a_flight"]["frames"] == table["a_flight"]["localized"] == "7"
    assert table["notes"]["reason"].startswith(f"{recordings[2]} cannot be read as a recording: ")
    assert table["a_flight"]["reason"] == ""
    assert main(["replay", recordings[0], *SHUTTER, "--out", str(tmp_path / "alone")]) == 0
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
        fleet, "perform_all", lambda tasks, *_: ((task, work(task)) for task in tasks if work)
    )


def test_results_of_other_settings_are_in_the_way(recordings, tmp_path, monkeypatch, ran):
    instead(monkeypatch, None)
    out = tmp_path / "out"
    words = ["replay", *recordings, "--out", str(out), *SHUTTER]
    (out / "a_flight").mkdir(parents=True)
    (out / "a_flight" / "mine").write_text("")
    for text in ("no marker", '{"settings": "another", "recording": "a", "figures": {}}'):
        (out / "a_flight" / "fleet.json").write_text(text)
        assert f"{out}/a_flight exists and is no result of this" in ran(*words, code=1).err
    assert main([*words, "--overwrite"]) == 1
    assert (out / "a_flight" / "mine").exists()  # until there is a better one
    assert rows(out)["b_flight"]["reason"] == "not done"


def test_what_goes_wrong_is_one_line(recordings, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(fleet, "_CONNECT_TIMEOUT", 0.5)
    words = ["replay", *recordings[:2], "--out"]
    assert main([*words, str(tmp_path / "out"), "--scheduler", "tcp://127.0.0.1:9"]) == 1
    assert "no Dask scheduler answers at tcp://127.0.0.1:9" in capsys.readouterr().err
    assert set(rows(tmp_path / "out")) == {"a_flight", "b_flight"}
    monkeypatch.setitem(sys.modules, "distributed", None)
    for more in (["--scheduler", "tcp://127.0.0.1:9"], ["--workers", "2"]):
        assert main(["replay", "a", "b", "--out", str(tmp_path / "other"), *more]) == 1
        assert "distributed" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def test_workers_that_cannot_do_it_say_why(tmp_path):
    (task,) = tasks_of([tmp_path / "bag"], tmp_path, _fail, "settings")
    assert "install the same" in str(
        perform_task(dataclasses.replace(task, settings="0.1 settings"))
    )
    elsewhere = dataclasses.replace(task, folder=tmp_path / "no" / "bag")
    assert f"does not see {tmp_path}/no" in str(perform_task(elsewhere))
    assert perform_task(task) == f"ZeroDivisionError: of {tmp_path}/bag"
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "a").mkdir()
    places = [tmp_path / "a" / "bag.mcap", tmp_path / "bag.mcap", tmp_path / "bag.mcap"]
    names = [task.folder.name for task in tasks_of(places, tmp_path, _fail, "")]
    assert names == ["a_bag", f"{tmp_path.name}_bag"]


def _fail(recording: Path, out: Path) -> dict[str, float]:
    out.mkdir()
    raise ZeroDivisionError(f"of {out}")


# A module that other processes find by its name, as they do not find this one.
DEADLY = """
import os, signal

def kill(recording, out):
    if recording.name == "deadly":
        os.kill(os.getpid(), signal.SIGKILL)
    out.mkdir()
    return {"frames": 1}

def leave(recording, out):
    os._exit(7)
"""


def test_a_recording_that_kills_its_process_does_not_stop_the_others(tmp_path, monkeypatch):
    """Dask blames all that waited at a worker, of which there is one."""
    pytest.importorskip("distributed", reason="needs Dask")
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "deadly_work.py").write_text(DEADLY)
    monkeypatch.syspath_prepend(tmp_path / "code")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "code"))
    work, out = importlib.import_module("deadly_work"), tmp_path / "out"
    out.mkdir()
    tasks = tasks_of([tmp_path / name for name in ("deadly", "good", "fine")], out, work.kill, "")
    tasks += tasks_of([tmp_path / "another"], out, work.leave, "")
    found = do_all(tasks, out, None, 1, lambda task, outcome: None)
    outcomes = {task.recording.name: found[task.folder] for task in tasks}
    assert outcomes["good"] == outcomes["fine"] == {"frames": 1}
    assert outcomes["deadly"].startswith("lost: ")
    assert outcomes["another"].startswith("lost: ")
    whole = {path.name for path in out.iterdir() if path.is_dir() and path.name[0] != "."}
    assert whole == {"fine", "good"}


def test_ctrl_c_leaves_whole_results_only_and_the_next_run_goes_on(
    recordings, tmp_path, monkeypatch, ran
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
    _, errors = running.communicate()
    assert (running.returncode, errors) == (130, "rs_localizer replay: interrupted\n")
    done = {name for name, row in rows(out).items() if not row["reason"]}
    assert {"0"} <= done
    assert {path.name for path in out.iterdir() if path.is_dir()} == done
    assert all((out / name / "fleet.json").is_file() for name in done)
    instead(monkeypatch, perform_task)
    assert f"{len(done)} of 3 recordings have been done before\n" in ran(*words).out
    assert {row["reason"] for row in rows(out).values()} == {""}
