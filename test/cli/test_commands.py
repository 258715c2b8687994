# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The command line itself: help, version, exit codes, and what is imported for it."""

import importlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
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
