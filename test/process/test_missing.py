"""Packages that are not installed: one sentence, whoever is started."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from catkin_pkg.package import parse_package

from rs_localizer.process.missing import explain

ROOT = Path(__file__).parents[2]
COMMAND = "import sys; from rs_localizer.__main__ import run; sys.exit(run())"
NODE = "import sys; from rs_localizer.ros.main import main; sys.exit(main())"
DETECTOR = "import sys; from rs_localizer.ros.main import marker_detector as m; sys.exit(m())"
# Nobody waits for what only commands need.
NOT_FOR_NODES = ("rosbags", "matplotlib", "PIL", "tqdm")


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
    return subprocess.run(
        command, env=environment, text=True, capture_output=True, timeout=120, check=False
    )


@pytest.mark.parametrize(
    ("name", "words", "advice"),
    [
        ("scipy", ("detect", "video.mp4"), "sudo apt install python3-scipy, or pip install scipy"),
        ("numba", ("detect", "video.mp4"), "pip install numba (beside Ubuntu's ROS with"),
        ("cv2", ("detect", "video.mp4"), "pip install opencv-python-headless"),
        ("tqdm", ("replay", "bag"), "sudo apt install python3-tqdm"),
        ("rosbags", ("evaluate", "a", "b"), "pip install rosbags"),
    ],
)
def test_a_command_says_it_in_one_line(tmp_path, name, words, advice):
    done = run(COMMAND, without(tmp_path, name), *words)
    assert done.returncode == 1
    assert done.stderr.startswith(
        f"rs_localizer {words[0]}: the Python package {name} is not installed: "
    )
    assert advice in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("code", [NODE, DETECTOR])
@pytest.mark.parametrize("name", ["scipy", "numba", "yaml"])
def test_a_node_says_it_in_one_line(tmp_path, name, code):
    pytest.importorskip("rclpy", reason="needs ROS 2")
    done = run(code, without(tmp_path, name))
    assert done.returncode == 1
    assert f": the Python package {name} is not installed: " in done.stderr
    assert done.stderr.count("\n") == 1


def test_nodes_do_not_wait_for_packages_of_commands(tmp_path):
    pytest.importorskip("rclpy", reason="needs ROS 2")
    code = "import rs_localizer.ros.node.managed, rs_localizer.ros.detector.markers"
    done = run(code, without(tmp_path, *NOT_FOR_NODES))
    assert (done.returncode, done.stderr) == (0, "")


def test_what_is_broken_tells_of_itself():
    text = explain(ImportError("numpy.core.multiarray failed to import"))
    assert text.startswith("numpy.core.multiarray failed to import; ")
    assert "not installed" not in text


def test_package_xml_has_no_key_that_rosdep_gives_to_pip():
    # Ubuntu 24.04 refuses pip beside apt, and rosdep stops before the keys that follow.
    package = parse_package(str(ROOT / "package.xml"))
    names = [item.name for item in (*package.exec_depends, *package.test_depends)]
    assert [name for name in names if name.endswith("-pip") or "numba" in name] == []
    assert {"python3-scipy", "python3-numpy", "python3-opencv", "python3-yaml"} <= set(names)


def test_rosdep_resolves_every_key_to_a_package_of_ubuntu():
    index = os.environ.get("ROSDISTRO")
    if index is None:
        pytest.skip("ROSDISTRO names no checkout of ros/rosdistro")
    yaml = pytest.importorskip("yaml")
    keys: dict[str, dict[str, object]] = {}
    for name in ("base", "python"):
        keys |= yaml.safe_load((Path(index) / "rosdep" / f"{name}.yaml").read_text())
    package = parse_package(str(ROOT / "package.xml"))
    used = {item.name for item in (*package.exec_depends, *package.test_depends)}
    system = {name for name in used if name.startswith("python3-")}
    for name in sorted(system):
        rule = keys[name]["ubuntu"]
        if isinstance(rule, dict):  # by release; '*' is all that have no line of their own
            rule = rule.get("noble", rule.get("*"))
        assert isinstance(rule, list), f"{name}: {rule}"
    released = yaml.safe_load((Path(index) / "jazzy" / "distribution.yaml").read_text())
    known = set()
    for name, item in released["repositories"].items():
        known |= set(item.get("release", {}).get("packages", [name]))
    assert used - system - known == set()
