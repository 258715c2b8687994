# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Modules in the working folder, a data set that somebody has sent, never run.

Each attack has a control: the same program without the defence runs them. A payload that nobody
could have reached would prove nothing.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# As ``python -m rs_localizer`` does it, and without the defence.
UNDEFENDED = (
    "import runpy, rs_localizer.process as process\n"
    "process.ignore_working_folder = lambda: None\n"
    "runpy.run_module('rs_localizer', run_name='__main__')\n"
)
# The same, itself as safe as Python can make it, which workers would not inherit.
SAFE_ALONE = f"import sys\nsys.path.remove('')\n{UNDEFENDED}"
# What Python imports by itself for any ``-m``: those cannot be kept out.
NOTHING = "import sys; print(*sys.modules)"
READOUT = ["readout", "iPhone"]
# Each is refused, in a process of its own, which needs no kernels for that.
FLEET = ["replay", "a.mcap", "b.mcap", "-p", "readout_time:=0.02", "--workers", "2", "--out", "out"]


@pytest.fixture
def sent(tmp_path) -> Path:
    """The folder of data; what runs of it adds its name to RAN beside it."""
    folder = tmp_path / "sent"
    folder.mkdir()
    for name in ("a.mcap", "b.mcap"):
        (folder / name).write_text("no recording")
    return folder


def plant(sent: Path, *names: str) -> None:
    for name in names:
        text = f"open({str(sent.parent / 'RAN')!r}, 'a').write({name!r} + ' ')\n"
        (sent / f"{name}.py").write_text(text)


def ran(sent: Path, *command: str, path: str = str(ROOT)) -> list[str]:
    """Names of the modules that ran."""
    (sent.parent / "RAN").write_text("")
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONSAFEPATH"}
    subprocess.run(
        [sys.executable, *command], cwd=sent, env=environment | {"PYTHONPATH": path},
        capture_output=True, timeout=300, check=False,
    )  # fmt: skip
    return (sent.parent / "RAN").read_text().split()


@pytest.mark.parametrize("name", ["selectors", "signal", "contextlib", "__future__", "tqdm"])
def test_of_the_program_itself(sent, name):
    (sent / "nothing.py").write_text(NOTHING)
    listed = subprocess.run(
        [sys.executable, "-m", "nothing"], cwd=sent, capture_output=True, text=True, check=True
    )
    if name in listed.stdout.split():
        pytest.skip("Python imports it before any program")
    plant(sent, name)
    assert ran(sent, "-c", UNDEFENDED, *READOUT) == [name]
    assert ran(sent, "-m", "rs_localizer", *READOUT) == []


def test_of_the_workers_of_a_fleet(sent):
    plant(sent, "selectors", "struct")
    assert len(ran(sent, "-c", SAFE_ALONE, *FLEET)) >= 2  # one in each worker
    assert ran(sent, "-m", "rs_localizer", *FLEET) == []
    assert len((sent / "out" / "summary.csv").read_text().splitlines()) == 3


def test_of_a_worker_that_another_program_has_started(sent):
    """As Dask does, which is started in any folder."""
    plant(sent, "later")
    work = (
        "import sys\nfrom pathlib import Path\n"
        "from rs_localizer.offline import fleet\n"
        "def later(*_):\n    import later\n"
        "out, said = Path('out').absolute(), f'{fleet.version(\"rs_localizer\")} x'\n"
        "task = fleet.Task(later, Path('a.mcap'), out, said)\n"
    )
    assert ran(sent, "-c", f"{work}later()") == ["later"]
    assert ran(sent, "-c", f"{work}fleet.perform_task(task)") == []


@pytest.mark.parametrize("path", [f":{ROOT}", f"{ROOT}:"])
def test_of_an_empty_entry_of_the_path(sent, path):
    plant(sent, "tqdm", "selectors")
    assert ran(sent, "-P", "-c", UNDEFENDED, *FLEET, path=path)
    program = "from rs_localizer.__main__ import run; run()"
    assert ran(sent, "-P", "-c", program, *FLEET, path=path) == []


def test_the_package_is_found_where_it_lies():
    done = subprocess.run(
        [sys.executable, "-m", "rs_localizer", *READOUT], cwd=ROOT, capture_output=True, check=False
    )
    assert done.returncode == 0
