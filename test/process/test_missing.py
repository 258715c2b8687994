# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Processes: packages that are missing, signals, and folders that are gone."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rs_localizer.process.missing import BESIDE_ROS, BOUNDS

ROOT = Path(__file__).parents[2]
COMMAND = "import sys; from rs_localizer.__main__ import run; sys.exit(run())"
NODE = "import sys; from rs_localizer.ros.main import main; sys.exit(main())"
DETECTOR = "import sys; from rs_localizer.ros.main import marker_detector as m; sys.exit(m())"
# Nobody waits for what only commands need.
NOT_FOR_NODES = ("rosbags", "matplotlib", "scipy", "PIL", "tqdm")


def without(tmp_path: Path, *names: str) -> dict[str, str]:
    """An environment in which packages seem not to be installed."""
    for name in names:
        text = f"raise ModuleNotFoundError(\"No module named '{name}'\", name='{name}')\n"
        (tmp_path / f"{name}.py").write_text(text)
    hook = (
        "import importlib.util as u\nfind = u.find_spec\n"
        f"u.find_spec = lambda name, *a: None if name in {names!r} else find(name, *a)\n"
    )
    (tmp_path / "sitecustomize.py").write_text(hook)
    path = [str(tmp_path), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path)}


def run(code: str, environment: dict[str, str], *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code, *words]
    return subprocess.run(command, env=environment, text=True, capture_output=True, check=False)


MISSING = "the Python package {} is not installed: "


@pytest.mark.parametrize(
    ("name", "code", "words", "said", "advice"),
    [
        ("scipy", COMMAND, ("calibrate", "video.mp4"), f"rs_localizer calibrate: {MISSING}",
         "sudo apt install python3-scipy, or pip install scipy"),
        ("rosbags", COMMAND, ("evaluate", "a", "b"), f"rs_localizer evaluate: {MISSING}",
         f'pip install "rosbags{BOUNDS["rosbags"]}"; '),
        ("rosbags", COMMAND, ("evaluate", "a", "b"), f"rs_localizer evaluate: {MISSING}",
         BESIDE_ROS),
        ("numpy", NODE, (), f"localizer: {MISSING}", "sudo apt install "),
        ("yaml", DETECTOR, (), f"marker_detector: {MISSING}", "sudo apt install "),
        ("rclpy", NODE, (), "localizer: No module named '{}'; source a ROS 2 workspace", ""),
    ],
)  # fmt: skip
def test_it_is_said_in_one_line(tmp_path, name, code, words, said, advice):
    if code != COMMAND:
        pytest.importorskip("rclpy", reason="needs ROS 2")
    done = run(code, without(tmp_path, name), *words)
    assert done.returncode == 1
    assert done.stderr.startswith(said.format(name))
    assert advice in done.stderr
    assert done.stderr.count("\n") == 1


def test_nodes_do_not_wait_for_packages_of_commands(tmp_path):
    pytest.importorskip("rclpy", reason="needs ROS 2")
    code = "import rs_localizer.ros.node.managed, rs_localizer.ros.detector.markers"
    done = run(code, without(tmp_path, *NOT_FOR_NODES))
    assert (done.returncode, done.stderr) == (0, "")


def stopped(program: str, **variables: str) -> tuple[int, str, str]:
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment | variables, text=True,
        capture_output=True, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize(("number", "heard"), [(signal.SIGTERM, True), (signal.SIGHUP, False)])
def test_only_nohup_is_inherited(number, heard):
    """A parent that has ignored SIGTERM would have its nodes never end."""
    program = f"""
import os, signal
from rs_localizer.process.stopping import StopRequest
signal.signal({number:d}, signal.SIG_IGN)
with StopRequest() as stop:
    os.kill(os.getpid(), {number:d})
    print(stop.requested)
"""
    assert stopped(program) == (0, f"{heard}\n", "")


def test_two_signals_at_once_are_one_interrupt():
    program = """
import os, signal
from rs_localizer.process.stopping import StopSignals
with StopSignals() as stop:
    try:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            os.kill(os.getpid(), signal.SIGINT)
            print("whole")
    except KeyboardInterrupt:
        print("interrupted", stop.requested)
"""
    assert stopped(program) == (0, "whole\ninterrupted True\n", "")


# How many threads each OpenBLAS that this process has loaded would use, by its own word.
ASK = """
import ctypes, re
import numpy, scipy.linalg
found = []
for path in set(re.findall(r"/.*openblas.*", open("/proc/self/maps").read())):
    library = ctypes.CDLL(path)
    for prefix in ("", "scipy_"):
        for suffix in ("", "64_"):
            name = f"{prefix}openblas_get_num_threads{suffix}"
            if hasattr(library, name):
                found.append(getattr(library, name)())
print(*found)
"""
IMPORTING = "import sys; sys.argv[1:] = ['--version']; from rs_localizer.__main__ import run; run()"
IMPORTING_NODE = "from contextlib import suppress; from rs_localizer.ros.main import main\n"
IMPORTING_NODE += "with suppress(SystemExit):\n    main(['--version'])\n"


@pytest.mark.parametrize(
    ("program", "variables"),
    [
        (IMPORTING, {}),
        (IMPORTING_NODE, {}),
        (IMPORTING, {"OPENBLAS_NUM_THREADS": "2"}),
    ],  # nor does a user
)
def test_one_thread_whose_bits_nobody_changes(program, variables):
    found = stopped(program + ASK, **variables)[1].split("\n")[-2].split()
    assert found == ["1"] * len(found)


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
        "from rs_localizer.offline import fleet, tasks\n"
        "def later(*_):\n    import later\n"
        "out, said = Path('out').absolute(), f'{tasks.VERSION} x'\n"
        "task = tasks.Task(later, Path('a.mcap'), out, said)\n"
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
