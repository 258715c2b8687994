# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The command line itself: help, version, exit codes, and what is imported for it."""

import argparse
import importlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

import rs_localizer
from rs_localizer.cli import UsageError
from rs_localizer.cli.main import COMMANDS, main
from rs_localizer.cli.map import ACTIONS
from rs_localizer.core.simd.jit import cache_directory
from rs_localizer.io.atomic_files import atomic_files


def run(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "rs_localizer", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_as_a_module():
    done = run("--version")
    assert done.returncode == 0
    assert done.stdout == f"rs_localizer {rs_localizer.__version__}\n"
    assert done.stderr == ""


def test_help_names_every_command_with_an_example(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    for name, command in COMMANDS.items():
        assert f"  {name} " in text
        assert f"$ {command.example}\n" in text
        assert command.example.startswith(f"rs_localizer {name}")


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_command_has_help_and_takes_its_example(name, capsys):
    assert main([name, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"usage: rs_localizer {name}" in text
    assert COMMANDS[name].example in text
    module = importlib.import_module(COMMANDS[name].module)
    parser = argparse.ArgumentParser()
    module.add_arguments(parser)
    parser.parse_args(COMMANDS[name].example.split()[2:])


def test_help_waits_for_nothing_that_only_work_needs():
    actions = [["map", action] for action in ACTIONS]
    script = f"""
import sys
from rs_localizer import cli
cli.WORKING = False
from rs_localizer.cli.main import main
for words in {[*([name] for name in COMMANDS), *actions]}:
    assert main([*words, "--help"]) == 0, words
    assert {{"numba", "scipy", "matplotlib", "pyarrow"}}.isdisjoint(sys.modules), words
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    command = [sys.executable, "-X", "importtime", "-m", "rs_localizer", "map", "build", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert "usage: rs_localizer map build " in done.stdout
    assert "numba" not in done.stderr


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["fly"], "invalid choice: 'fly'; choose from demo, replay"),
        (["repaly"], "invalid choice: 'repaly'; did you mean replay?"),
        (["replay"], "the following arguments are required: RECORDING"),
        (["replay", "bag", "-p", "sead:=1"], "'sead' is not a setting"),
        (["replay", "a", "b"], "many recordings need --out DIR"),
        (["calibrate", "x", "--out", "x.txt"], "x.txt"),
        (["evaluate", "a"], "give EST and TRUTH"),
    ],
)
def test_wrong_usage(words, text, capsys):
    assert main(words) == 2
    captured = capsys.readouterr()
    assert text in captured.err
    assert captured.out == ""


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (ValueError("it is\n  bent"), 1, "rs_localizer replay: it is bent\n"),
        (OSError(28, "No space left on device"), 1, "No space left on device\n"),
        (UsageError("not so"), 2, "rs_localizer replay: not so\n"),
        (KeyboardInterrupt(), 130, "rs_localizer replay: interrupted\n"),
    ],
)
def test_faults_are_one_line_and_an_exit_code(error, code, text, monkeypatch, capsys):
    def fail(arguments: argparse.Namespace) -> None:
        raise error

    command = SimpleNamespace(add_arguments=lambda parser: None, run=fail)
    monkeypatch.setitem(sys.modules, COMMANDS["replay"].module, command)
    assert main(["replay"]) == code
    assert capsys.readouterr().err.endswith(text)


def test_a_signal_while_the_workplace_is_removed(tmp_path, monkeypatch):
    remove = shutil.rmtree

    def interrupted(path: Path, ignore_errors: bool = False) -> None:
        monkeypatch.setattr(shutil, "rmtree", remove)
        raise KeyboardInterrupt

    def make(arguments: argparse.Namespace) -> None:
        with atomic_files(tmp_path / "map.yaml") as (part,):
            part.write_text("whole")
            monkeypatch.setattr(shutil, "rmtree", interrupted)

    command = SimpleNamespace(add_arguments=lambda parser: None, run=make)
    monkeypatch.setitem(sys.modules, COMMANDS["replay"].module, command)
    assert main(["replay"]) == 130
    assert [path.name for path in tmp_path.iterdir()] == ["map.yaml"]


def test_what_a_command_prints_as_json(monkeypatch, capsys):
    results: list[object] = [{"residual (px)": math.nan, "poses": 3}, None]

    def run(arguments: argparse.Namespace) -> object:
        sys.stdout.write(
            "a line\nnext: rs_localizer evaluate\n" if len(results) > 1 else "a line\n"
        )
        return results.pop(0)

    command = SimpleNamespace(add_arguments=lambda parser: None, run=run)
    monkeypatch.setitem(sys.modules, COMMANDS["replay"].module, command)
    expected = {
        "command": "replay",
        "result": {"residual (px)": None, "poses": 3},
        "next": "rs_localizer evaluate",
    }
    assert main(["replay", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == expected
    assert main(["replay", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"command": "replay", "text": ["a line"]}


def test_quiet_and_verbose(monkeypatch, capsys):
    def run(arguments: argparse.Namespace) -> None:
        sys.stdout.write("a line\n")
        raise ValueError("a fault")

    command = SimpleNamespace(add_arguments=lambda parser: None, run=run)
    monkeypatch.setitem(sys.modules, COMMANDS["replay"].module, command)
    assert main(["replay", "-q"]) == 1
    assert capsys.readouterr() == ("", "rs_localizer replay: a fault\n")
    assert main(["replay", "-v"]) == 1
    said = capsys.readouterr()
    assert said.out == "a line\n"
    assert "Traceback" in said.err
    assert said.err.endswith("rs_localizer replay: a fault\n")


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("rs_localizer rep", {"replay"}),
        ("rs_localizer evaluate --pl", {"--plot"}),
        ("rs_localizer simulate out --scan-direction l", {"left_to_right"}),
        ("rs_localizer map build --mar", {"--markers"}),
    ],
)
def test_shells_complete(tmp_path, line, expected):
    pytest.importorskip("argcomplete")
    asked = {
        "_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": " ", "COMP_LINE": line,
        "COMP_POINT": str(len(line)), "_ARGCOMPLETE_SUPPRESS_SPACE": "1", "COMP_TYPE": "9",
        "_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "answer"),
    }  # fmt: skip
    subprocess.run(
        [sys.executable, "-m", "rs_localizer"], env={**os.environ, **asked}, timeout=120, check=True
    )
    assert {word.strip() for word in (tmp_path / "answer").read_text().split()} == expected


def test_names_cannot_steer_the_terminal(monkeypatch, capsys):
    def run(arguments: argparse.Namespace) -> None:
        sys.stdout.write("frame \x1b]0;title\x07 \x9b2J\n\tä\n")
        raise ValueError("no topic \x1b[2J")

    command = SimpleNamespace(add_arguments=lambda parser: None, run=run)
    monkeypatch.setitem(sys.modules, COMMANDS["replay"].module, command)
    assert main(["replay"]) == 1
    captured = capsys.readouterr()
    assert captured.out == "frame \\x1b]0;title\\x07 \\x9b2J\n\tä\n"
    assert captured.err == "rs_localizer replay: no topic \\x1b[2J\n"


def test_a_fault_in_the_program_keeps_its_traceback(monkeypatch):
    def fail(arguments: argparse.Namespace) -> None:
        raise TypeError("a bug")

    command = SimpleNamespace(add_arguments=lambda parser: None, run=fail)
    monkeypatch.setitem(sys.modules, COMMANDS["replay"].module, command)
    with pytest.raises(TypeError, match="a bug"):
        main(["replay"])


# A module that tells that it is being imported, and takes its time.
SLOW = "import pathlib, time; pathlib.Path(__file__).with_suffix('.seen').touch(); time.sleep(60)"


@pytest.mark.parametrize(
    ("slow", "number"), [("numba", signal.SIGINT), ("rosbags", signal.SIGTERM)]
)
def test_signals_while_a_command_is_imported(tmp_path, number, slow):
    (tmp_path / f"{slow}.py").write_text(SLOW)
    process = subprocess.Popen(
        [sys.executable, "-m", "rs_localizer", "replay", "bag"],
        env={**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while not (tmp_path / f"{slow}.seen").exists():
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(number)
    output, errors = process.communicate(timeout=30)
    assert (process.returncode, output) == (128 + number, "")
    assert errors == "rs_localizer replay: interrupted\n"


def test_ctrl_c_while_a_command_runs_leaves_nothing_in_the_way(tmp_path):
    words = ["simulate", "bag", "--duration", "3000"]
    process = subprocess.Popen(
        [sys.executable, "-m", "rs_localizer", *words],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(rs_localizer.__file__).parents[1])},
        stderr=subprocess.PIPE,
        text=True,
    )
    while not list(tmp_path.glob(".unfinished-*/bag")):
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (130, "rs_localizer simulate: interrupted\n")
    assert list(tmp_path.iterdir()) == []


def test_who_stops_reading_is_not_told_of_it():
    """As with ``| head -1``: more is written than the pipe holds."""
    code = (
        "import sys; from types import SimpleNamespace as N; import rs_localizer.cli.main as c\n"
        "def run(_):\n"
        "    for _ in range(100_000): print('a line of a long table')\n"
        "sys.modules['rs_localizer.cli.map'] = N(add_arguments=lambda p: None, run=run)\n"
        "sys.exit(c.main(['map']))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stderr is not None
    assert process.stdout.readline() == "a line of a long table\n"
    process.stdout.close()
    assert process.stderr.read() == ""
    process.stderr.close()
    assert process.wait(timeout=60) == 141


def test_it_says_where_the_kernels_are(capsys):
    assert main(["warm", "--solver", "p3p"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line[:10].strip() for line in lines[:2]] == ["markers", "solver p3p"]
    assert lines[2:] == [f"kernels are in {cache_directory()}"]
    assert list(cache_directory().rglob("*.nbc"))
    assert main(["warm", "--solver", "p3p", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)["result"]
    assert list(result["seconds"]) == ["markers", "solver p3p"]
    assert result["kernels"] == str(cache_directory())


def test_kernels_that_cannot_be_kept_are_a_failure(tmp_path):
    (tmp_path / "cache").write_text("a file in its place")
    done = subprocess.run(
        [sys.executable, "-m", "rs_localizer", "warm", "--solver", "p3p"],
        env={**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")},
        text=True,
        capture_output=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith(f"rs_localizer warm: cache of kernels in {tmp_path}/cache/")
    assert done.stderr.endswith(("Not a directory\n", "File exists\n"))
    assert done.stderr.count("\n") == 1
