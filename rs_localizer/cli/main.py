"""``rs_localizer COMMAND``: finds the command, turns its faults into one line and an exit code.

Exit codes: 0 done, 1 the work failed, 2 wrong usage; 130 after Ctrl-C, 143 after SIGTERM, and 141
when who reads the output goes away (``| head``).
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import rs_localizer
from rs_localizer.cli import UsageError
from rs_localizer.io.atomic_files import remove_unfinished
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
    ``run(arguments)``.
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
        "rs_localizer detect video.mp4 --map wall.yaml --calibration camera.yaml --rate 30 "
        "--out seen",
    ),
    "calibrate": Command(
        "rs_localizer.cli.calibrate",
        "readout time, scan direction and lens of a camera, from a recording in which it moves",
        "rs_localizer calibrate video.mp4 --board 9x6 --square 0.025 --rate 30 --out shutter.yaml",
    ),
    "readout": Command(
        "rs_localizer.cli.readout",
        "what others say of a camera's readout time: median, spread, sources",
        "rs_localizer readout imx219 1920x1080",
    ),
    "evaluate": Command(
        "rs_localizer.cli.evaluate",
        "errors of estimated poses and twists against the truth, as tables and plots",
        "rs_localizer evaluate flight_poses flight",
    ),
    "map": Command(
        "rs_localizer.cli.map",
        "make a map of a room or of markers, refine, align and convert it, say what it holds",
        "rs_localizer map build walk.mp4 --calibration lens.yaml --rate 30 --out room",
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
    try:
        name = _parser().parse_args(words[:1]).command
        command = COMMANDS[name]
        with importing(f"rs_localizer {name}"):
            module = importlib.import_module(command.module)
        parser = argparse.ArgumentParser(
            prog=f"rs_localizer {name}",
            description=_sentence(command.summary),
            epilog=f"example:\n  {command.example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        module.add_arguments(parser)
        arguments = parser.parse_args(words[1:])
    except SystemExit as end:  # argparse has said all there is to say
        return int(end.code or 0)
    except ImportError as error:
        return _fail(name, explain(error), 1)
    StopRequest.clean_up.append(remove_unfinished)
    try:
        with _plain_output() if name != "watch" else nullcontext():
            module.run(arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        return _unheard()
    except UsageError as error:
        return _fail(name, str(error), 2)
    except (ValueError, OSError) as error:
        return _fail(name, str(error), 1)
    except ImportError as error:  # of what only some of its work needs
        return _fail(name, explain(error), 1)
    except MemoryError as error:
        return _fail(name, f"the memory does not suffice: {error}", 1)
    except KeyboardInterrupt:
        return _fail(name, "interrupted", INTERRUPTED)
    return 0


def _fail(name: str, text: str, code: int) -> int:
    shown = " ".join(text.split()).translate(_STEERING)
    print(f"rs_localizer {name}: {shown}", file=sys.stderr)
    return code


@contextlib.contextmanager
def _plain_output() -> Iterator[None]:
    """Within ``with``, what is printed cannot steer the terminal."""
    write = sys.stdout.write
    output = sys.stdout
    output.write = lambda text: write(text.translate(_STEERING))  # type: ignore[method-assign]
    try:
        yield
    finally:
        output.write = write  # type: ignore[method-assign]


def _unheard() -> int:
    """Nobody reads the output any more; to say so would be heard by nobody either."""
    with contextlib.suppress(OSError, ValueError):
        # What is left in the buffer would be written at the end of the process, and fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return _SIGPIPE


def _parser() -> argparse.ArgumentParser:
    width = max(map(len, COMMANDS))
    lines = [
        f"  {name:{width}}  {command.summary}\n  {'':{width}}  $ {command.example}"
        for name, command in COMMANDS.items()
    ]
    parser = argparse.ArgumentParser(
        prog="rs_localizer",
        description="Position, orientation and velocity of a rolling-shutter camera.",
        epilog="\n".join(["commands:", *lines, "", "rs_localizer COMMAND --help says more."]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "--version", action="version", version=f"rs_localizer {rs_localizer.__version__}"
    )
    parser.add_argument(
        "command", metavar="COMMAND", choices=COMMANDS, help=f"one of {', '.join(COMMANDS)}"
    )
    return parser


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."
