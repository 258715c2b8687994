# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer COMMAND``: finds the command, turns its faults into one line and an exit code.

Exit codes: 0 done, 1 the work failed, 2 wrong usage; 130 after Ctrl-C, 143 after SIGTERM, and 141
when who reads the output goes away (``| head``).
"""

from __future__ import annotations

import argparse
import contextlib
import difflib
import importlib
import io
import json
import math
import os
import sys
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import rs_localizer
from rs_localizer.cli import COMMON, LateParser, UsageError, add_common
from rs_localizer.io.atomic_files import remove_unfinished
from rs_localizer.io.remote import is_url, placed_beside
from rs_localizer.process.missing import explain
from rs_localizer.process.stopping import INTERRUPTED, StopRequest

# What shells report of a program whose output nobody reads any more: 128 + SIGPIPE.
_SIGPIPE = 141
# Characters that steer terminals: names in recordings and files may hold them.
_STEERING = {
    code: f"\\x{code:02x}" for code in (*range(32), *range(0x7F, 0xA0)) if chr(code) not in "\n\t"
}


@dataclass(frozen=True, slots=True)
class Command:
    """A command: what it does, and a line that a user can try.

    Its module, imported only when it is chosen, offers ``add_arguments(parser)`` and
    ``run(arguments)``, which prints, and returns what ``--json`` prints instead, or None.
    """

    module: str
    summary: str
    example: str


COMMANDS = {
    "demo": Command(
        "rs_localizer.cli.demo",
        "play the bundled recordings through the real node; ends with a table and pictures",
        "rs_localizer demo --out out",
    ),
    "replay": Command(
        "rs_localizer.cli.replay",
        "a recording in; poses and twists out, as text files and as a bag",
        "rs_localizer replay flight -p readout_time:=0.03 --out flight_poses",
    ),
    "simulate": Command(
        "rs_localizer.cli.simulate",
        "write a recording with ground truth: a scene, a motion, a rolling-shutter camera",
        "rs_localizer simulate flight --trajectory poses.txt --duration 30 --noise 1",
    ),
    "markers": Command(
        "rs_localizer.cli.markers",
        "make prints of markers or a board, true to scale, with their map; check a map",
        "rs_localizer markers make wall --family apriltag_36h11 --page a4",
    ),
    "detect": Command(
        "rs_localizer.cli.detect",
        "find markers or a board in a video, a bag or a folder of images; writes a recording",
        "rs_localizer detect video.mp4 --map wall.yaml --calibration camera.yaml --params "
        "shutter.yaml --out seen",
    ),
    "calibrate": Command(
        "rs_localizer.cli.calibrate",
        "readout time, scan direction and lens of a camera that moves in a recording; or of a rig",
        "rs_localizer calibrate video.mp4 --board 9x6 --square 0.025 --out shutter.yaml",
    ),
    "readout": Command(
        "rs_localizer.cli.readout",
        "published readout times of a camera: median, spread, sources",
        "rs_localizer readout imx219 1920x1080",
    ),
    "evaluate": Command(
        "rs_localizer.cli.evaluate",
        "errors of estimated poses and twists against the truth, as tables and plots",
        "rs_localizer evaluate flight_poses flight",
    ),
    "map": Command(
        "rs_localizer.cli.map",
        "make a map of a room or of markers; refine, align, convert and describe it",
        "rs_localizer map build walk.mp4 --calibration lens.yaml --params shutter.yaml --out room",
    ),
    "rectify": Command(
        "rs_localizer.cli.rectify",
        "images as a global shutter would have taken them, from the poses of replay",
        "rs_localizer rectify video.mp4 --calibration lens.yaml --params shutter.yaml "
        "--poses poses --depth plane --map wall.yaml --out global",
    ),
    "watch": Command(
        "rs_localizer.cli.watch",
        "how a live localizer is: rate, pose, speeds, deviations, state; refreshed in place",
        "rs_localizer watch front/rs_localizer",
    ),
    "localize-hloc": Command(
        "rs_localizer.cli.localize_hloc",
        "poses and velocities of what hloc has matched, with the rolling shutter",
        "rs_localizer localize-hloc --reference-sfm sfm --queries queries.txt "
        "--retrieval pairs.txt --features features.h5 --matches matches.h5 --results poses.txt "
        "-p readout_time:=0.03",
    ),
    "warm": Command(
        "rs_localizer.cli.warm",
        "compile all kernels now, for images and installers; the first start is then as any other",
        "rs_localizer warm",
    ),
}


def main(
    argv: Sequence[str] | None = None,
    importing: Callable[[str], AbstractContextManager[object]] = nullcontext,
) -> int:
    """Run one command.

    Args:
        argv: defaults to the process's arguments.
        importing: entered, with the name of the command, while its module is imported.

    Returns:
        the exit code.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    common, words = _common_options(words)
    if (url := _url_of_out(words)) is None:
        return _run(words, common, importing)
    try:
        if "--scheduler" in words:
            raise UsageError("--out: workers need a folder that all of them see, not a URL")
        with placed_beside(url) as place:
            code = _run(
                [str(place) if word == url else word for word in words], common, importing,
                lambda text: text.replace(str(place), url.rstrip("/")),
            )  # fmt: skip
            if code:
                raise SystemExit(code)  # nothing of it is placed
    except SystemExit as end:
        return int(end.code or 0)
    except Exception as error:
        if (fault := _said(words[0], error)) is not None:
            return fault
        raise
    return code


def _url_of_out(words: Sequence[str]) -> str | None:
    """Where the result is to be, if that is no place of this machine."""
    at = words.index("--out") + 1 if "--out" in words else 0
    return words[at] if 0 < at < len(words) and is_url(words[at]) else None


def _run(
    words: Sequence[str],
    common: set[str],
    importing: Callable[[str], AbstractContextManager[object]],
    shown: Callable[[str], str] = str,
) -> int:
    """Run one command; ``shown`` changes what it prints."""
    try:
        name = _parser().parse_args(words[:1]).command
        command = COMMANDS[name]
        with importing(f"rs_localizer {name}"):
            module = importlib.import_module(command.module)
        summary = command.summary
        parser = _described(
            f"rs_localizer {name}", f"{summary[0].upper()}{summary[1:]}.",
            f"example:\n  {command.example}",
        )  # fmt: skip
        add_common(parser)
        module.add_arguments(parser)
        arguments = parser.parse_args(words[1:])
    except SystemExit as end:  # argparse has said all there is to say
        return int(end.code or 0)
    except ImportError as error:
        return _fail(name, explain(error), 1)
    StopRequest.clean_up.append(remove_unfinished)
    try:
        with _output(name, common, shown):
            result = module.run(arguments)
            printed = sys.stdout
        if "--json" in common and isinstance(printed, io.StringIO):
            print(shown(_json(name, result, printed.getvalue())))
        sys.stdout.flush()
    except Exception as error:
        if "--verbose" in common:
            traceback.print_exc()
        code = _said(name, error)
        if code is None:
            raise
        return code
    except KeyboardInterrupt:
        remove_unfinished()  # it may have come while that was being removed
        return _fail(name, "interrupted", INTERRUPTED)
    return 0


def _said(name: str, error: Exception) -> int | None:
    """Say what went wrong; the exit code, None for a fault in the program."""
    match error:
        case BrokenPipeError():
            return _unheard()
        case UsageError():
            return _fail(name, str(error), 2)
        case ValueError() | OSError():
            return _fail(name, str(error), 1)
        case ImportError():  # of what only some of its work needs
            return _fail(name, explain(error), 1)
        case MemoryError():
            return _fail(name, f"the memory does not suffice: {error}", 1)
    return None


def _common_options(words: Sequence[str]) -> tuple[set[str], list[str]]:
    """Options of all commands that are among the words, and the other words."""
    names = {"-q": "--quiet", "-v": "--verbose"} | {name: name for name, _ in COMMON}
    end = words.index("--") if "--" in words else len(words)
    first, rest = list(words[1:end]), list(words[end:])
    common = {names[word] for word in first if word in names}
    return common, [*words[:1], *(word for word in first if word not in names), *rest]


@contextlib.contextmanager
def _output(name: str, common: Collection[str], shown: Callable[[str], str]) -> Iterator[None]:
    """Within ``with``, what is printed cannot steer the terminal, and goes where options say."""
    if name == "watch":
        yield
    elif "--json" in common or "--quiet" in common:
        # No bar either, which is for a person who waits.
        sys.stderr.isatty = lambda: False  # type: ignore[method-assign]
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    else:
        output, write = sys.stdout, sys.stdout.write
        output.write = lambda text: write(shown(text).translate(_STEERING))  # type: ignore
        try:
            yield
        finally:
            output.write = write  # type: ignore[method-assign]


_NEXT = "next: "


def _json(name: str, result: Any, printed: str) -> str:
    """The figures of a command and what comes next, or the lines that it has printed."""
    lines = printed.splitlines()
    content: dict[str, Any] = {"text": lines} if result is None else {"result": result}
    following = [line.removeprefix(_NEXT) for line in lines if line.startswith(_NEXT)]
    if following and result is not None:
        content["next"] = following[-1]
    return json.dumps({"command": name, **_as_json(content)}, indent=1)


def _as_json(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _as_json(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_json(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if isinstance(value, (bool, int, type(None))) else str(value)


def complete() -> None:
    """Answer a shell that asks how to complete a line, if one does (argcomplete)."""
    if "_ARGCOMPLETE" not in os.environ:
        return
    import argcomplete

    parser = argparse.ArgumentParser(prog="rs_localizer", allow_abbrev=False)
    commands = parser.add_subparsers(parser_class=LateParser)
    for name, command in COMMANDS.items():
        own = commands.add_parser(name, help=command.summary)
        own.come_from(command.module)
        add_common(own)
    argcomplete.autocomplete(parser)


def _fail(name: str, text: str, code: int) -> int:
    shown = " ".join(text.split()).translate(_STEERING)
    print(f"rs_localizer {name}: {shown}", file=sys.stderr)
    return code


def _unheard() -> int:
    """Nobody reads the output any more; to say so would be heard by nobody either."""
    with contextlib.suppress(OSError, ValueError):
        # What is left in the buffer would be written at the end of the process, and fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return _SIGPIPE


def _described(name: str, description: str, end: str) -> argparse.ArgumentParser:
    return argparse.ArgumentParser(
        prog=name, description=description, epilog=end, allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip


def _parser() -> argparse.ArgumentParser:
    width = max(map(len, COMMANDS))
    lines = [
        f"  {name:{width}}  {command.summary}\n  {'':{width}}  $ {command.example}"
        for name, command in COMMANDS.items()
    ]
    parser = _described(
        "rs_localizer",
        "Position, orientation and velocity of a rolling-shutter camera.",
        "\n".join(["commands:", *lines, "", "rs_localizer COMMAND --help says more."]),
    )
    parser.add_argument(
        "--version", action="version", version=f"rs_localizer {rs_localizer.__version__}"
    )
    parser.add_argument(
        "command", metavar="COMMAND", type=_command, help=f"one of {', '.join(COMMANDS)}"
    )
    return parser


def _command(name: str) -> str:
    if name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {close[0]}?" if close else f"choose from {', '.join(COMMANDS)}"
        raise argparse.ArgumentTypeError(f"invalid choice: {name!r}; {hint}")
    return name
