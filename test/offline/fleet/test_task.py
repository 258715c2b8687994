# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""One recording of many: whole or not there, and done again only when it has changed."""

import csv
import json
import os
import random
import subprocess
import sys
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import killing
import pytest

from rs_localizer.cli.batch import CSV, DONE, FAILED, Row, write_summary
from rs_localizer.offline.fleet import task as first
from rs_localizer.offline.fleet.task import (
    LOG,
    MARKER,
    PARTIAL,
    Figures,
    Kind,
    Task,
    finished,
    folder_names,
    identity,
    perform,
    program,
)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr(first, "cache_directory", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def count_letters(args: Namespace, recording: Path, out: Path) -> Figures:
    """Stands for a command: reads, prints, writes."""
    text = recording.read_text()
    out.mkdir()
    (out / "half").write_text(text[:1])
    sys.stdout.write(f"reading into {out}\n")
    sys.stderr.write("odd\n")
    if args.fault is not None:
        raise args.fault
    (out / "letters").write_text(str(len(text)))
    return {"letters": len(text), "of": 0.1 + 0.2, "said": "a|b"}


def task(tmp_path: Path, *, fault: BaseException | None = None, kernels: str = "none") -> Task:
    recording = tmp_path / "in" / "text"
    recording.parent.mkdir(exist_ok=True)
    if not recording.exists():
        recording.write_text("hello")
    (tmp_path / "out").mkdir(exist_ok=True)
    return Task(
        Kind("count", count_letters, kernels),
        Namespace(fault=fault),
        recording,
        tmp_path / "out",
        "text",
        identity("count", {}, [recording]),
        program(),
    )


def test_a_result_is_whole_and_tells_what_it_is_of(tmp_path):
    given = task(tmp_path)
    assert finished(given) is None
    outcome = perform(given)
    assert outcome.figures == {"letters": 5, "of": 0.1 + 0.2, "said": "a|b"}
    assert (outcome.name, outcome.reason) == ("text", "")
    assert sorted(file.name for file in given.folder.iterdir()) == [
        *(MARKER, "half", "letters", LOG)
    ]
    assert (given.folder / LOG).read_text() == "reading into text\nodd\n"
    marker = json.loads((given.folder / MARKER).read_text())
    assert marker["recording"] == str(given.recording)
    assert marker["program"] == program()
    assert finished(given) == outcome.figures
    assert list((given.out / PARTIAL).iterdir()) == []


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (ValueError("it is\n  bent"), "it is bent"),
        (OSError(28, "No space left on device"), "[Errno 28] No space left on device"),
        (MemoryError("no 3 GB"), "MemoryError: no 3 GB"),
        (ZeroDivisionError(), "ZeroDivisionError: ZeroDivisionError"),
    ],
)
def test_a_fault_is_a_reason_and_leaves_nothing(tmp_path, fault, reason):
    given = task(tmp_path, fault=fault)
    outcome = perform(given)
    assert (outcome.figures, outcome.reason) == (None, reason)
    assert list(given.out.iterdir()) == [given.out / PARTIAL]
    assert list((given.out / PARTIAL).iterdir()) == []


def test_identity_is_of_settings_files_and_times(tmp_path):
    recording = tmp_path / "bag"
    recording.mkdir()
    (recording / "data").write_text("1")
    os.utime(recording / "data", ns=(10**18, 10**18))
    first_one = identity("replay", {"a": 1}, [recording])
    assert identity("replay", {"a": 1}, [recording]) == first_one
    others = {
        identity("replay", {"a": 2}, [recording]),
        identity("detect", {"a": 1}, [recording]),
        identity("replay", {"a": 1}, [recording, recording]),
    }
    os.utime(recording / "data", ns=(10**18, 10**18 + 1))
    others.add(identity("replay", {"a": 1}, [recording]))
    assert len(others | {first_one}) == 5


def test_the_first_one_compiles_alone(tmp_path, cache):
    """Of three processes that need the same kernels, two wait until the first one has them."""
    log = tmp_path / "log"
    code = (
        "import os, sys, time\n"
        "from pathlib import Path\n"
        "from rs_localizer.offline.fleet import task as first\n"
        "first.cache_directory = lambda: Path(sys.argv[1])\n"
        "def say(text):\n"
        "    with open(sys.argv[2], 'a') as log: log.write(text)\n"
        "with first.alone_until_compiled('k'):\n"
        "    say('('); time.sleep(0.3); say(')')\n"
    )
    started = [
        subprocess.Popen([sys.executable, "-c", code, str(cache), str(log)]) for _ in range(3)
    ]
    assert [process.wait(60) for process in started] == [0, 0, 0]
    assert log.read_text().startswith("()")
    assert len(log.read_text()) == 6
    # And nobody waits any more: one within the other would for ever.
    with first.alone_until_compiled("k"), first.alone_until_compiled("k"):
        pass


def test_a_first_one_that_fails_leaves_the_next_one_first(tmp_path, cache):
    def marks() -> list[Path]:
        return [file for file in (cache / "fleet").iterdir() if file.suffix != ".lock"]

    perform(task(tmp_path, fault=ValueError(), kernels="k"))
    assert marks() == []
    perform(task(tmp_path, kernels="k"))
    assert len(marks()) == 1


def test_who_can_compile_alone_does_no_more_alone(tmp_path, cache):
    """While the first one works, a second one may come; who works has compiled nothing itself.

    Kernels round differently in the process that has compiled them than in those that load them.
    """
    log = tmp_path / "said"
    given = replace(task(tmp_path, kernels="k"), arguments=Namespace(said=log))
    said: list[str] = []

    def work(args: Namespace, recording: Path, out: Path) -> Figures:
        with first.alone_until_compiled("k") as is_first:
            said.append(f"work, first: {is_first}")
        return {}

    kind = Kind("count", work, "k", killing.tell)
    assert perform(replace(given, kind=kind)).figures == {}
    perform(replace(given, kind=kind, name="again"))
    assert said == ["work, first: False", "work, first: False"]
    (compiled,) = log.read_text().splitlines()
    assert compiled.startswith("compiled by ")
    assert compiled != f"compiled by {os.getpid()}"


def test_what_cannot_be_compiled_says_why(tmp_path):
    given = replace(task(tmp_path, kernels="k"), arguments=Namespace(said=tmp_path))
    kind = Kind("count", count_letters, "k", killing.tell)
    assert "Is a directory" in perform(replace(given, kind=kind)).reason


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["/a/flight", "/a/drive.mcap"], ["flight", "drive"]),
        (["/a/flight", "/b/flight", "/b/other"], ["a_flight", "b_flight", "other"]),
        (["/a/x/flight", "/b/x/flight"], ["a_x_flight", "b_x_flight"]),
        (["/flight", "/b/flight"], ["flight", "b_flight"]),
        (["/a/one.mcap", "/a/one.db3"], ["a_one.mcap", "a_one.db3"]),
    ],
)
def test_parents_tell_those_of_one_name_apart(paths, names):
    assert folder_names([Path(path) for path in paths]) == names


def test_all_names_differ_and_are_names():
    rng = random.Random(0)
    parts = ["a", "b", "a_b", "b.x"]
    for _ in range(300):
        paths = {Path("/", *rng.choices(parts, k=rng.randint(1, 4))) for _ in range(12)}
        names = folder_names(list(paths))
        assert len(set(names)) == len(paths)
        assert all(name and "/" not in name for name in names)


def test_no_cell_is_a_formula(tmp_path):
    rows = [
        Row(Path("=cmd|' /C calc'!A0"), "@sum", DONE, {"offset": -0.5, "why": "+1+1"}),
        Row(Path("b"), "-c", FAILED, {}, "=1+1"),
    ]
    write_summary(tmp_path, "replay", rows)
    _, first, second = csv.reader((tmp_path / CSV).read_text().splitlines())
    assert first == ["'=cmd|' /C calc'!A0", "'@sum", DONE, "-0.5", "'+1+1", ""]
    assert second == ["b", "'-c", FAILED, "", "", "'=1+1"]
