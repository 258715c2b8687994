# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The command line itself: help, exit codes, imports; and many recordings by one command."""

import csv
import dataclasses
import filecmp
import importlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import fields, make_dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import rs_localizer
from rs_localizer.cli.commands import COMMANDS, main, parse
from rs_localizer.cli.options import UsageError
from rs_localizer.io.atomic_files import atomic_files
from rs_localizer.native import COMPILES
from rs_localizer.offline import fleet
from rs_localizer.offline.fleet import do_all, perform_task
from rs_localizer.offline.tasks import Outcome, Task, tasks_of


def run(*words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "rs_localizer", *words],
        capture_output=True, text=True, env={**os.environ, **variables},
    )  # fmt: skip


def start(*words: str, **more: Any) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "rs_localizer", *words],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **more,
    )  # fmt: skip


def test_as_a_module():
    done = run("--version")
    version = f"rs_localizer {rs_localizer.__version__}\n"
    assert (done.returncode, done.stdout, done.stderr) == (0, version, "")


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_command_has_help_and_takes_its_example(name, ran):
    example = COMMANDS[name].example
    assert f"$ {example}\n" in ran("--help").out
    text = ran(*name.split(), "--help").out
    assert f"usage: rs_localizer {name}" in text
    assert example in text
    module = importlib.import_module(COMMANDS[name].module)
    parse(name, module, example.split()[1 + len(name.split()) :])


def test_options_are_few():
    modules = [importlib.import_module(command.module) for command in COMMANDS.values()]
    every = [item.metadata for module in modules for item in fields(module.Options)]
    assert sum(not about.get("positional", True) for about in every) <= 120


@pytest.mark.skipif(COMPILES, reason="kernels are not those of the native module, Numba runs them")
def test_commands_are_imported_without_what_few_of_them_need():
    names = [command.module for command in COMMANDS.values()]
    code = f"import importlib, sys\nfor name in {names}:\n    importlib.import_module(name)\n"
    code += "print({'numba', 'matplotlib', 'pyarrow', 'av', 'pycolmap'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
    assert "numpy" not in run("--help", PYTHONPROFILEIMPORTTIME="1").stderr


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["map", "bild"], "there is no command 'map bild'; did you mean map build?"),
        (["repaly"], "there is no command 'repaly'; did you mean replay?"),
        (["replay", "bag", "--smoth"], "unrecognized arguments: --smoth; did you mean --smooth?"),
        (["replay"], "the following arguments are required: RECORDING"),
        (["replay", "bag", "-p", "sead:=1"], "'sead' is not a setting"),
        (["replay", "a", "b"], "many recordings need --out DIR"),
        (["simulate", "x", "--rig", "c.yaml", "--imu"], "--rig goes without --imu"),
        (["calibrate", "--rig", "video.mp4"], "--rig needs the recordings of several cameras, or"),
        (["calibrate", "--rig", "a/cam.mp4", "b/cam.mp4"], "cameras need different names"),
        (["calibrate", "--rig", "1.mp4", "b.mp4"], "names that begin with a letter: 1, b"),
        (["calibrate", "--rig", "a.mp4", "b.mp4", "--imu"], "--imu is for one camera"),
    ],
)
def test_wrong_usage(words, text, ran):
    captured = ran(*words, code=2)
    assert text in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


@pytest.fixture
def command(monkeypatch) -> SimpleNamespace:
    """What is run in the place of replay."""
    fake = SimpleNamespace(Options=make_dataclass("Options", []))
    monkeypatch.setitem(sys.modules, COMMANDS["replay"].module, fake)
    return fake


def raising(error: BaseException) -> Any:
    def run(options: Any) -> None:
        # Names in recordings cannot steer the terminal.
        sys.stdout.write("frame \x1b]0;title\x07 \x9b2J\n\tä\n")
        raise error

    return run


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (ValueError("it is\n  bent \x1b[2J"), 1, "rs_localizer replay: it is bent \\x1b[2J\n"),
        (OSError(28, "No space left on device"), 1, "No space left on device\n"),
        (UsageError("not so"), 2, "rs_localizer replay: not so\n"),
        (KeyboardInterrupt(), 130, "rs_localizer replay: interrupted\n"),
    ],
)
def test_faults_are_one_line_and_an_exit_code(error, code, text, command, ran):
    command.run = raising(error)
    said = ran("replay", code=code)
    assert said.out == "frame \\x1b]0;title\\x07 \\x9b2J\n\tä\n"
    assert said.err.endswith(text)


def test_tracebacks_are_those_of_faults_in_the_program_and_of_verbose(command, ran):
    command.run = raising(ValueError("a fault"))
    said = ran("replay", "-v", code=1).err
    assert "Traceback" in said
    assert said.endswith("rs_localizer replay: a fault\n")
    command.run = raising(TypeError("a bug"))
    with pytest.raises(TypeError, match="a bug"):
        main(["replay"])


def test_a_signal_while_the_workplace_is_removed(tmp_path, monkeypatch, command):
    remove = shutil.rmtree

    def interrupted(path: Path, ignore_errors: bool = False) -> None:
        monkeypatch.setattr(shutil, "rmtree", remove)
        raise KeyboardInterrupt

    def make(options: Any) -> None:
        with atomic_files(tmp_path / "map.yaml") as (part,):
            part.write_text("whole")
            monkeypatch.setattr(shutil, "rmtree", interrupted)

    command.run = make
    assert main(["replay"]) == 130
    assert [path.name for path in tmp_path.iterdir()] == ["map.yaml"]


@pytest.mark.parametrize(
    ("result", "told"),
    [
        (
            {"residual_px": math.nan, "poses": 3},
            {"result": {"residual_px": None, "poses": 3}, "next": "rs_localizer evaluate"},
        ),
        (None, {"text": ["a line", "next: rs_localizer evaluate"]}),
    ],
)
def test_what_a_command_prints_as_json(result, told, command, ran):
    def run(options: Any) -> object:
        sys.stdout.write("a line\nnext: rs_localizer evaluate\n")
        return result

    command.run = run
    for words in (["replay", "--json"], ["--json", "replay"]):
        assert json.loads(ran(*words).out) == {"command": "replay", **told}


# A module that tells that it is being imported, and takes its time.
SLOW = "import pathlib, time; pathlib.Path(__file__).with_suffix('.seen').touch(); time.sleep(9999)"


@pytest.mark.parametrize(("slow", "number"), [("cv2", signal.SIGINT), ("rosbags", signal.SIGTERM)])
def test_signals_while_a_command_is_imported(tmp_path, number, slow):
    (tmp_path / f"{slow}.py").write_text(SLOW)
    path = f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"
    process = start("replay", "bag", env={**os.environ, "PYTHONPATH": path})
    while not (tmp_path / f"{slow}.seen").exists():
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(number)
    output, errors = process.communicate()
    assert (process.returncode, output) == (128 + number, "")
    assert errors == "rs_localizer replay: interrupted\n"


def test_ctrl_c_while_a_command_runs_leaves_nothing_in_the_way(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(Path(rs_localizer.__file__).parents[1])}
    words = ["simulate", "bag", "--duration", "3000"]
    process = start(*words, cwd=tmp_path, env=environment)
    while not list(tmp_path.glob(".unfinished-*/bag")):
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate()
    assert (process.returncode, errors) == (130, "rs_localizer simulate: interrupted\n")
    assert list(tmp_path.iterdir()) == []


def test_who_stops_reading_is_not_told_of_it():
    """As with ``| head -1``: more is written than the pipe holds."""
    code = (
        "import sys; from dataclasses import dataclass\n"
        "from types import SimpleNamespace as N; import rs_localizer.cli.commands as c\n"
        "def run(_):\n"
        "    for _ in range(100_000): print('a line of a long table')\n"
        "Options = dataclass(type('O', (), {}))\n"
        "sys.modules['rs_localizer.cli.readout_command'] = N(Options=Options, run=run)\n"
        "sys.exit(c.main(['readout']))"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == "a line of a long table\n"
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


@pytest.mark.parametrize("how", ["in PATH", "by its place", "as a module"])
def test_what_comes_next_can_be_pasted(how, tmp_path):
    """After ``make`` nothing is in PATH; what is printed runs from where it was printed."""
    place = tmp_path / "clone of mine" / ".venv" / "bin"
    place.mkdir(parents=True)
    (place / "python").symlink_to(sys.executable)
    program = place / "rs_localizer"
    program.write_text(
        f"#!{sys.executable}\nimport sys\nfrom rs_localizer.__main__ import run\nsys.exit(run())\n"
    )
    program.chmod(0o755)
    begin, path = [str(program)], "/usr/bin:/bin"
    if how == "in PATH":
        begin, path = ["rs_localizer"], f"{place}:{path}"
    elif how == "as a module":
        begin = [sys.executable, "-m", "rs_localizer"]
    work = tmp_path / "clone of mine"
    paths = [str(Path(__file__).parents[2]), *filter(None, [os.environ.get("PYTHONPATH")])]
    more = {"cwd": work, "env": {**os.environ, "PATH": path, "PYTHONPATH": ":".join(paths)}}
    words = ["simulate", "my flight", "--duration", "0.2", "--json"]
    done = subprocess.run([*begin, *words], capture_output=True, text=True, check=True, **more)
    command = json.loads(done.stdout)["next"]
    assert (command.split()[0] == "rs_localizer") == (how == "in PATH")
    if how == "by its place":
        assert command.startswith(".venv/bin/rs_localizer ")
    pasted = subprocess.run(
        ["bash", "-c", f"{command} --help"], capture_output=True, text=True, check=False, **more
    )
    assert pasted.returncode == 0, pasted.stderr
    assert "usage: rs_localizer replay" in pasted.stdout


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
