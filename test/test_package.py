# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The package as ROS, colcon, pip and Python see it: description, versions, content, names."""

import ast
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import setuptools
import yaml
from catkin_pkg.changelog import get_changelog_from_path
from catkin_pkg.package import parse_package

import rs_localizer
import rs_localizer as rsl
from rs_localizer import data
from rs_localizer.native import build
from rs_localizer.process import missing

ROOT = Path(__file__).parents[1]


def test_package_xml_is_valid_and_of_the_right_kind():
    # With an invalid one (its e-mail address, say) colcon silently sees a plain Python package.
    warnings: list[str] = []
    package = parse_package(str(ROOT / "package.xml"), warnings=warnings)
    assert warnings == []
    assert package.name == "rs_localizer"
    assert package.get_build_type() == "ament_python"
    assert package.licenses == ["Apache-2.0", "CC-BY-4.0"]  # code, and bundled recordings


def test_versions_agree():
    version = parse_package(str(ROOT / "package.xml")).version
    # The one form that catkin_prepare_release finds and raises.
    assert re.findall(r'version="(\d+\.\d+\.\d+)",', (ROOT / "setup.py").read_text()) == [version]
    assert rs_localizer.__version__ == version
    changes = get_changelog_from_path(str(ROOT / "CHANGELOG.rst"))
    released = [name for name, *_ in changes.foreach_version(reverse=True)]
    # Until the first tag all stands in "Forthcoming", which says what that will be.
    first = f"\nForthcoming\n-----------\nVersion {version}, the first."
    assert released[:1] == [version] or first in (ROOT / "CHANGELOG.rst").read_text()
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    recipe = (ROOT / "packaging" / "conda" / "recipe.yaml").read_text()
    assert f'\n  version: "{version}"' in recipe


# conda's names, where they differ from pip's.
CONDA = {"opencv-python-headless": "py-opencv", "PyYAML": "pyyaml"}


@pytest.fixture
def setup_says(monkeypatch) -> Callable[[Path], dict[str, Any]]:
    """What setup.py says in a folder."""
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)

    def says(folder: Path) -> dict[str, Any]:
        said: dict[str, Any] = {}
        monkeypatch.chdir(folder)
        monkeypatch.setattr(setuptools, "setup", lambda **options: said.update(options))
        code = compile((ROOT / "setup.py").read_text(), "setup.py", "exec")
        exec(code, {"__name__": "__main__"})
        return said

    return says


def test_shared_files_lie_where_ros_looks_and_commands_can_be_imported(setup_says):
    """What of it a wheel has, ``.ci/check_wheel.py`` and the smoke tests of CI see."""
    said = setup_says(ROOT)
    shared = {f"{to}/{Path(file).name}" for to, files in said["data_files"] for file in files}
    expected = {"ament_index/resource_index/packages/rs_localizer", "rs_localizer/package.xml"}
    expected |= {f"rs_localizer/config/{path.name}" for path in (ROOT / "config").glob("*")}
    expected |= {f"rs_localizer/launch/{path.name}" for path in (ROOT / "launch").glob("*.py")}
    assert shared == {f"share/{name}" for name in expected}
    declared = dict(line.split(" = ") for line in said["entry_points"]["console_scripts"])
    names = "doctor localizer marker_detector feature_detector rs_localizer"
    assert set(declared) == set(names.split())
    for name, value in declared.items():
        assert callable(EntryPoint(name, value, "console_scripts").load()), value


def test_bounds_are_the_same_everywhere(setup_says):
    said = setup_says(ROOT)
    asked = {f"{name}{versions}" for name, versions in missing.BOUNDS.items()}
    assert f"rosbags{missing.BOUNDS['rosbags']}" in said["install_requires"]
    numba = f"numba{missing.BOUNDS['numba']}"
    assert numba in said["extras_require"]["test"]
    assert numba in tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    low, high = (".".join(map(str, bound)) for bound in build.NUMBA)
    assert missing.BOUNDS["numba"] == f">={low},<{high}"
    for file in ("docs/install.md", "packaging/docker/ros.Dockerfile", ".github/workflows/ros.yml"):
        text = (ROOT / file).read_text()
        (line,) = re.findall(r"pip install .*--break-system-packages ([^;\n]*)", text)
        assert {word for word in shlex.split(line) if ">=" in word} == asked, file


def test_the_lowest_set_is_within_the_bounds(setup_says):
    command = [sys.executable, str(ROOT / ".ci" / "versions.py"), "lowest"]
    done = subprocess.run(command, cwd=ROOT, text=True, capture_output=True, check=True)
    lowest, asked = done.stdout.split(), setup_says(ROOT)["install_requires"]
    assert [line.replace("==", ">=").removesuffix(".0.*") for line in lowest] == [
        line.partition(",")[0] for line in asked
    ]
    assert sum("==" in line for line in lowest) == sum(">=" in line for line in asked) >= 3


def test_conda_brings_what_pip_brings(setup_says):
    declared, wanted = setup_says(ROOT), {}
    recipe = yaml.safe_load((ROOT / "packaging/conda/recipe.yaml").read_text())
    for line in declared["install_requires"]:
        name, bound = re.fullmatch(r"([\w-]+)(.*)", line).groups()
        wanted[CONDA.get(name, name)] = bound
    found = dict((*line.split(), "")[:2] for line in recipe["requirements"]["run"])
    assert found.pop("python") == declared["python_requires"]
    assert found == wanted


def test_the_container_is_built_of_files_that_exist():
    text = (ROOT / "packaging" / "docker" / "Dockerfile").read_text()
    copied = set(" ".join(re.findall(r"^COPY (?!--)(.*) \S+$", text, re.MULTILINE)).split())
    assert [name for name in copied if not (ROOT / name).exists()] == []
    # All that setup.py reads, and what the commands run.
    assert {"setup.py", "setup.cfg", "pyproject.toml", "package.xml", "README.md"} <= copied
    assert {"rs_localizer", "config", "launch", "resource"} <= copied


def test_beside_ros_pip_requires_nothing(monkeypatch, setup_says):
    """Ubuntu's OpenCV is no pip package: a requirement would stop the executables."""
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy")
    assert setup_says(ROOT)["install_requires"] == ["setuptools"]


def test_rosdep_knows_every_key():
    keys = yaml.safe_load((ROOT / "test" / "rosdep_keys.yaml").read_text())
    package = parse_package(ROOT / "package.xml")
    kinds = ("exec_depends", "test_depends", "build_depends", "buildtool_depends")
    named = {item.name for kind in kinds for item in getattr(package, kind)}
    assert named == keys["apt"].keys() | keys["after jazzy"].keys() | keys["ros"].keys()
    for names in (keys["apt"], keys["after jazzy"]):
        assert all(name.startswith("python3-") for name in names.values())  # and none by pip


@pytest.mark.parametrize(("distribution", "numba"), [("jazzy", False), ("lyrical", True)])
def test_numba_is_asked_for_where_ubuntu_has_it(distribution, numba):
    package = parse_package(ROOT / "package.xml")
    package.evaluate_conditions({"ROS_DISTRO": distribution})
    chosen = {item.name for item in package.exec_depends if item.evaluated_condition}
    assert ("python3-numba" in chosen) is numba
    assert "python3-numpy" in chosen


def test_bundled_recordings_are_attributed_and_small():
    root = data.path(".")
    files = [file for file in root.rglob("*") if file.is_file() and file.suffix != ".pyc"]
    assert sum(file.stat().st_size for file in files) < 6_000_000
    for folder in (child for child in root.iterdir() if child.is_dir()):
        if folder.name != "__pycache__":
            text = (folder / "ATTRIBUTION.md").read_text()
            licences = ("CC BY 4.0", "CC0", "Apache License, Version 2.0")
            assert any(licence in text for licence in licences)


def test_every_public_name_is_there():
    for name in rsl.__all__:
        assert getattr(rsl, name).__module__.startswith("rs_localizer.")
    assert set(rsl.__all__) <= set(dir(rsl))
    chosen: dict[str, object] = {}
    exec("from rs_localizer import *; from rs_localizer import Camera", chosen)
    assert chosen["Camera"] is rsl.Camera
    assert set(rsl.__all__) <= set(chosen)


def test_type_checkers_see_the_same_names():
    nodes = ast.walk(ast.parse(Path(rsl.__file__).read_text()))
    imports = [
        node for node in nodes
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("rs_localizer")
    ]  # fmt: skip
    seen = {alias.name: node.module for node in imports for alias in node.names}
    assert sorted(seen) == rsl.__all__
    homes = {name: module for module, names in rsl._HOMES.items() for name in names}
    assert {name: f"rs_localizer.{module}" for name, module in homes.items()} == seen


@pytest.mark.parametrize(
    "module", ["rs_localizer", "rs_localizer.__main__", "rs_localizer.ros.main"]
)
def test_programs_start_with_light_imports(module):
    code = (
        f"import sys, {module}\n"
        "heavy = ('numpy', 'numba', 'cv2', 'rclpy', 'rosbags', 'scipy', 'matplotlib')\n"
        "sys.exit([name for name in sys.modules if name.startswith(heavy)])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.strip() == "[]"


@pytest.mark.parametrize(
    ("said", "call"),
    [
        ("roi.width must be a whole", lambda localizer: rsl.Roi(0, 0, "5", 5)),
        ("expected_share must be be", lambda it: it.localize([], [], expected_share="0.5")),
        ("rotation must be of type R", lambda it: it.localize([], [], rotation=3)),
        ("a: .points, pixels. or .po", lambda it: rsl.Localizer(
            rsl.Rig({"a": it.camera}, {"a": (np.eye(3), np.zeros(3))})).localize({"a": 3})),
        ("angular_velocity_deviation", lambda localizer: rsl.Prior(
            angular_velocity=(0, 0, 1), angular_velocity_deviation="x")),
        ("aid must be of type Aid, g", lambda localizer: rsl.Tracker(localizer, aid=5)),
        ("max_prediction must be 0 s", lambda it: rsl.Tracker(it, max_prediction="1")),
        ("time_ns must be a whole nu", lambda localizer: rsl.Tracker(localizer).at(None)),
        ("prior must be of type Prio", lambda localizer: rsl.Tracker(localizer).expect(0, 3)),
        ("context must be of type Fr", lambda it: rsl.Tracker(it).localize(0, [], [], context=3)),
        ("iterations must be 1 or mo", lambda it: rsl.solve_minimal(
            "p3p", np.zeros((1, 3, 3)), np.zeros((1, 3, 2)), np.zeros((1, 3)), iterations="x")),
    ],
)  # fmt: skip
def test_what_cannot_be_meant_is_refused_by_its_name(said, call):
    K = [[500, 0, 320], [0, 500, 240], [0, 0, 1]]
    with pytest.raises(ValueError, match=f"^{said}"):
        call(rsl.Localizer(rsl.Camera(640, 480, K, readout_time=0.03)))
