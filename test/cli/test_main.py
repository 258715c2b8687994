"""The command line itself: help, version, exit codes, and what is imported for it."""

from __future__ import annotations

import argparse
import importlib
import subprocess
import sys
from types import SimpleNamespace

import pytest

import rs_localizer
from rs_localizer.cli import UsageError
from rs_localizer.cli.main import COMMANDS, main


def run(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "rs_localizer", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_as_a_module() -> None:
    done = run("--version")
    assert done.returncode == 0
    assert done.stdout == f"rs_localizer {rs_localizer.__version__}\n"
    assert done.stderr == ""


def test_help_names_every_command_with_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    for name, command in COMMANDS.items():
        assert f"  {name} " in text
        assert f"$ {command.example}\n" in text
        assert command.example.startswith(f"rs_localizer {name}")


@pytest.mark.parametrize("name", list(COMMANDS))
def test_every_command_has_help_and_takes_its_example(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([name, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"usage: rs_localizer {name}" in text
    assert COMMANDS[name].example in text
    module = importlib.import_module(COMMANDS[name].module)
    parser = argparse.ArgumentParser()
    module.add_arguments(parser)
    parser.parse_args(COMMANDS[name].example.split()[2:])


def test_help_imports_no_command() -> None:
    code = (
        "import sys; from rs_localizer.cli.main import main; main(['--help']);"
        "sys.exit([m for m in sys.modules if m.startswith(('rosbags', 'matplotlib', 'rclpy'))])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stderr.strip() == "[]"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ([], "the following arguments are required: COMMAND"),
        (["fly"], "invalid choice: 'fly'"),
        (["--nonsense"], "COMMAND"),
        (["replay"], "the following arguments are required: BAG"),
        (["replay", "bag", "--nonsense"], "unrecognized arguments: --nonsense"),
        (["replay", "bag", "--storage", "tape"], "invalid choice: 'tape'"),
    ],
)
def test_wrong_usage(words: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
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
        (KeyboardInterrupt(), 1, "rs_localizer replay: interrupted\n"),
    ],
)
def test_faults_are_one_line_and_an_exit_code(
    error: BaseException,
    code: int,
    text: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(arguments: argparse.Namespace) -> None:
        raise error

    command = SimpleNamespace(add_arguments=lambda parser: None, run=fail)
    monkeypatch.setitem(sys.modules, COMMANDS["replay"].module, command)
    assert main(["replay"]) == code
    assert capsys.readouterr().err.endswith(text)


def test_a_fault_in_the_program_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(arguments: argparse.Namespace) -> None:
        raise TypeError("a bug")

    command = SimpleNamespace(add_arguments=lambda parser: None, run=fail)
    monkeypatch.setitem(sys.modules, COMMANDS["replay"].module, command)
    with pytest.raises(TypeError, match="a bug"):
        main(["replay"])
