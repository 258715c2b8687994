# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer COMMAND``: finds the command, turns its faults into one line and an exit code.

Exit codes: 0 done, 1 the work failed, 2 wrong usage; 130 after Ctrl-C, 143 after SIGTERM, and 141
    when the reader of the output has closed it (``| head``).
"""

from __future__ import annotations

import contextlib
import importlib
import io
import itertools
import json
import math
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from types import ModuleType
from typing import Any, NamedTuple

import rs_localizer
from rs_localizer.cli.options import MORE, CommonOptions, Parser, UsageError, add_options, read
from rs_localizer.config import meant
from rs_localizer.io.atomic_files import remove_unfinished
from rs_localizer.process.missing import explain
from rs_localizer.process.stopping import INTERRUPTED, StopRequest

# Exit code that shells report of a program whose output nobody reads: 128 + SIGPIPE.
_SIGPIPE = 141
# Characters that steer terminals: names in recordings and files may hold them.
_STEERING = {
    code: f"\\x{code:02x}" for code in (*range(32), *range(0x7F, 0xA0)) if chr(code) not in "\n\t"
}


class Command(NamedTuple):
    """A command: a description, and a line that a user can try.

    Its module, imported only when it is chosen, offers the dataclass ``Options`` and
    ``run(options)``, which prints, and returns what ``--json`` prints instead, or None.
    """

    module: str
    summary: str
    example: str


COMMANDS = {
    name: Command(
        f"rs_localizer.cli.{name.removesuffix(' make').replace(' ', '.')}_command",
        summary,
        f"rs_localizer {name} {words}".rstrip(),
    )
    for name, summary, words in (
        (
            "demo", "localize the bundled recordings; a table, and a picture of the errors",
            "--out out",
        ),
        (
            "replay", "a recording in; poses and twists out, as text files and as a bag",
            "flight -p readout_time:=0.03 --out flight_poses",
        ),
        (
            "simulate",
            "write a recording with ground truth: a scene, a motion, a rolling-shutter camera",
            "flight --trajectory poses.txt --duration 30 --noise 1",
        ),
        (
            "markers make", "prints of markers or a board, true to scale, with their map",
            "wall --family apriltag_36h11 --page a4",
        ),
        (
            "detect",
            "find markers or a board in a video, a bag or a folder of images; writes a recording",
            "video.mp4 --map wall.yaml --camera camera.yaml --out seen",
        ),
        (
            "calibrate",
            "readout time, scan direction and lens of a camera that moves in a recording, or a rig",
            "video.mp4 --board 9x6 --square 0.025 --out camera.yaml",
        ),
        (
            "readout", "published readout times of a camera: median, spread, sources",
            "imx219 1920x1080",
        ),
        (
            "evaluate", "errors of estimated poses and twists against the truth",
            "flight_poses flight",
        ),
        (
            "map build",
            "a map of landmarks from images: structure by COLMAP, refined with the rolling shutter",
            "walk.mp4 --camera camera.yaml --out room",
        ),
        (
            "map survey", "find the poses of all markers that a recording shows, by their sizes",
            "wall.mp4 --family apriltag_36h11 --size 0.15 --camera camera.yaml --out wall.yaml",
        ),
        (
            "map refine", "adjust a map with the rolling shutter that saw it, or COLMAP's model",
            "seen --map room.npz --out refined.npz",
        ),
        (
            "map align",
            "write a map to another file; in metres, z up, with an origin, where these are given",
            "room.npz level.npz --up 0 -1 0 --origin 7",
        ),
        ("map info", "describe a map, and name sizes in other units", "wall.yaml"),
    )
}  # fmt: skip


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
    name, common = "", CommonOptions()
    try:
        name, words = _chosen(sys.argv[1:] if argv is None else argv)
        with importing(f"rs_localizer {name}"):
            module = importlib.import_module(COMMANDS[name].module)
        options, common = parse(name, module, words)
        StopRequest.clean_up.append(remove_unfinished)
        with _output(common) as kept:
            result = module.run(options)
        if common.json and kept is not None:
            print(_json(name, result, kept.getvalue()))
        sys.stdout.flush()
    except SystemExit as end:  # argparse has said all there is to say
        return int(end.code or 0)
    except KeyboardInterrupt:
        remove_unfinished()  # it may have come while that was being removed
        return _fail(name, "interrupted", INTERRUPTED)
    except Exception as error:
        if common.verbose:
            traceback.print_exc()
        code = _report_error(name, error)
        if code is None:
            raise
        return code
    return 0


def parse(name: str, module: ModuleType, words: Sequence[str]) -> tuple[Any, CommonOptions]:
    """Parse the options of a command, and the common ones.

    Raises:
        UsageError: for words that it does not understand.
    """
    summary = COMMANDS[name].summary
    parser = Parser(
        prog=f"rs_localizer {name}",
        description=f"{summary[0].upper()}{summary[1:]}.",
        epilog=f"example:\n  {COMMANDS[name].example}",
    )
    add_options(parser, module.Options, CommonOptions)
    found = parser.parse_args(list(words))
    return read(module.Options, found), read(CommonOptions, found)


def _chosen(given: Sequence[str]) -> tuple[str, Sequence[str]]:
    """Return the command, of one or two words, and its options, which may stand before it."""
    before = list(itertools.takewhile(lambda word: word.startswith("-"), given))
    words = given[len(before) :]
    for count in (2, 1):
        if (name := " ".join(words[:count])) in COMMANDS:
            return name, [*before, *words[count:]]
    of_group = [name for name in COMMANDS if words and name.startswith(f"{words[0]} ")]
    if of_group and (len(words) == 1 or words[1] in ("-h", "--help")):
        print(_listed(of_group))
        raise SystemExit(0 if len(words) > 1 else 2)
    if not words:
        parser = Parser(
            prog="rs_localizer",
            usage="rs_localizer COMMAND ...",
            description="Position, orientation and velocity of a rolling-shutter camera.",
            epilog=f"commands:\n{_listed(COMMANDS)}\n\nrs_localizer COMMAND --help says more.",
        )
        version = f"rs_localizer {rs_localizer.__version__}"
        parser.add_argument("--version", action="version", version=version)
        add_options(parser, CommonOptions)
        parser.parse_args(before)
        raise UsageError(f"give a COMMAND{MORE}")
    name = " ".join(words[:2]) if of_group else words[0]
    known = of_group or list(dict.fromkeys(each.split()[0] for each in COMMANDS))
    raise UsageError(f"there is no command {name!r}{meant(name, known, 'choose from')}{MORE}")


def _listed(names: Iterable[str]) -> str:
    width = max(map(len, COMMANDS))
    return "\n".join(
        f"  {name:{width}}  {COMMANDS[name].summary}\n  {'':{width}}  $ {COMMANDS[name].example}"
        for name in names
    )


def _report_error(name: str, error: Exception) -> int | None:
    """Print what went wrong and return the exit code; None for a fault in the program."""
    match error:
        case BrokenPipeError():  # nobody reads any more
            with contextlib.suppress(OSError, ValueError):
                # Text that is left in the buffer would be written at the end, and fail again.
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return _SIGPIPE
        case ValueError() | OSError():
            return _fail(name, str(error), 2 if isinstance(error, UsageError) else 1)
        case ImportError():  # of what only some of its work needs
            return _fail(name, explain(error), 1)
        case MemoryError():
            return _fail(name, f"the memory does not suffice: {error}", 1)
    return None


@contextlib.contextmanager
def _output(common: CommonOptions) -> Iterator[io.StringIO | None]:
    """Keep printed text from steering the terminal, within the context; yield hidden text."""
    if common.json:
        # No bar either, which is for a person who waits.
        sys.stderr.isatty = lambda: False  # type: ignore[method-assign]
        with contextlib.redirect_stdout(io.StringIO()) as kept:
            yield kept
    else:
        output, write = sys.stdout, sys.stdout.write
        output.write = lambda text: write(text.translate(_STEERING))  # type: ignore
        try:
            yield None
        finally:
            output.write = write  # type: ignore[method-assign]


_NEXT = "next: "


def _json(name: str, result: Any, printed: str) -> str:
    """Return the figures of a command and what comes next, or the lines that it has printed."""
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


def _fail(name: str, text: str, code: int) -> int:
    shown = " ".join(text.split()).translate(_STEERING)
    print(f"{' '.join(['rs_localizer', *name.split()])}: {shown}", file=sys.stderr)
    return code
