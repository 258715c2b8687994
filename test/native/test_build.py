# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The tool that builds kernels: what it reads, what it refuses, and what its C relies on."""

import ctypes
import os
import platform
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from rs_localizer.native import build, sources

HERE = Path(__file__).parent
NUMBERS = 13


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a C compiler")
def test_our_header_says_what_pythons_says(tmp_path):
    include = Path(sysconfig.get_paths()["include"])
    if not (include / "Python.h").is_file():
        pytest.skip("needs Python's headers")
    made, objects = tmp_path / "both.so", [tmp_path / "theirs.o", tmp_path / "ours.o"]
    for file, folder in zip(objects, (include, sources.PACKAGE / "native"), strict=True):
        source = HERE / f"abi3_{file.stem}.c"
        subprocess.run(["gcc", "-fPIC", "-c", source, "-I", folder, "-o", file], check=True)
    subprocess.run(["gcc", "-shared", *objects, "-o", made], check=True)
    both = ctypes.CDLL(str(made))
    assert both.their_count() > 10
    for i in range(both.their_count()):
        assert both.our(i) == both.their(i)
    for i in range(NUMBERS):
        assert both.our_number(i) == both.their_number(i)


def test_a_digest_follows_callees_in_other_files():
    assert "rs_localizer.core.so3" in sources.closure("rs_localizer.estimation.robust")
    assert "rs_localizer.estimation.robust" not in sources.closure("rs_localizer.core.so3")


def test_no_kernel_is_compiled_from_the_reasons():
    closures = map(sources.closure, sources.kernel_modules())
    assert not any("rs_localizer.core.reasons" in closure for closure in closures)


@pytest.mark.parametrize(
    ("text", "is_same"),
    [
        ('"""More."""\ndef f(x):\n    """Say."""\n    return x + 1  # why\n', True),
        ("def f(x):\n\n    return (x + 1)\n", True),
        ("def f(x):\n    return x + 2\n", False),
    ],
)
def test_comments_and_docstrings_compile_nothing_anew(tmp_path, text, is_same):
    before, after = tmp_path / "before.py", tmp_path / "after.py"
    before.write_text("def f(x):\n    return x + 1\n")
    after.write_text(text)
    assert (sources.digest_of_code(before) == sources.digest_of_code(after)) == is_same


@pytest.mark.parametrize(
    ("version", "is_known"), [("0.60.0", False), ("0.68.1", True), ("0.99.0", False)]
)
def test_a_numba_that_was_not_tried_is_refused_with_what_to_type(monkeypatch, version, is_known):
    monkeypatch.setattr(build.importlib.metadata, "version", lambda name: version)
    if is_known:
        assert build.check_numba() == version
    else:
        with pytest.raises(build.CannotBuild, match='pip install "numba>='):
            build.check_numba()


def compiled(to, level, *modules, path=sources.PACKAGE.parent, **environment):
    """A folder with the kernels of modules, compiled for a level by a process of its own."""
    to.mkdir(exist_ok=True)
    environment |= build._environment(level, True) | {"RS_LOCALIZER_KERNELS": "build"}
    command = [sys.executable, "-m", "rs_localizer.native.bitcode", to, build._CPUS[level]]
    command += [f"{platform.machine()}-unknown-linux-gnu", *modules]
    environment = os.environ | environment | {"PYTHONPATH": str(path)}
    subprocess.run(command, env=environment, cwd=to, check=True)
    return to


GIVING = """
import numpy as np
from rs_localizer.core.arrays import Array, Array2
from rs_localizer.native import entry


@entry
def parts(table: Array2) -> tuple[Array, Array, Array, float]:
    twice, unused = 2.0 * table, np.ones(len(table))
    if table[0, 0] < 0.0:
        raise ValueError("less than nothing")
    return twice[1:, ::2], twice.T, twice, unused.sum()
"""


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a C compiler")
def test_parts_of_arrays_are_given_and_all_are_freed(tmp_path):
    (tmp_path / "giving.py").write_text(GIVING)
    path = os.pathsep.join(map(str, (tmp_path, sources.PACKAGE.parent)))
    compiled(tmp_path, "v2" if platform.machine() == "x86_64" else "generic", "giving", path=path)
    module, native = tmp_path / "_kernels_test.so", sources.PACKAGE / "native"
    command = ["gcc", "-O2", "-shared", "-fPIC", "-I", native, '-DRS_LEVEL="test"']
    command += ["-DRS_LEVEL_NAME=test", native / "runtime.c", tmp_path / "table.c"]
    subprocess.run([*command, tmp_path / "kernels.o", "-lm", "-o", module], check=True)
    given = run_in_a_process(GIVEN, module)
    assert given == "1000 kB at most\n"


GIVEN = """
import gc, importlib.machinery, importlib.util, resource, sys
import numpy as np
loader = importlib.machinery.ExtensionFileLoader("_kernels_test", sys.argv[1])
module = importlib.util.module_from_spec(importlib.util.spec_from_loader("_kernels_test", loader))
loader.exec_module(module)
parts = module.bound("giving.parts").call
table = np.arange(1.0, 20_001.0).reshape(100, 200)
for k in range(3000):
    if k == 500:
        gc.collect()
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    some, turned, whole, total = parts(table)
    try:
        parts(-table)
    except ValueError as error:
        assert str(error) == "less than nothing"
    else:
        raise AssertionError
grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
print("1000 kB at most" if grown < 1000 else f"{grown} kB")
for found, wanted in ((some, 2 * table[1:, ::2]), (turned, 2 * table.T), (whole, 2 * table)):
    np.testing.assert_array_equal(found, wanted)
    assert found.flags.c_contiguous and found.flags.owndata
assert total == 100.0
"""


def run_in_a_process(code, *arguments):
    command = [sys.executable, "-c", code, *map(str, arguments)]
    environment = {k: v for k, v in os.environ.items() if k != "RS_LOCALIZER_KERNELS"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_modules_with_kernels_import_numpy_and_no_other_package():
    """The build imports them, in an environment that has nothing else."""
    code = (
        "import importlib, sys\n"
        "class Refusing:\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        first = name.partition('.')[0]\n"
        "        known = {'rs_localizer', 'numpy', 'numba', 'llvmlite', *sys.stdlib_module_names}\n"
        "        if first not in known:\n"
        "            raise ImportError(f'{name} is imported')\n"
        "sys.meta_path.insert(0, Refusing())\n"
        "for name in sys.argv[1].split():\n"
        "    importlib.import_module(name)\n"
    )
    run_in_a_process(code, " ".join(sources.kernel_modules()))


@pytest.mark.skipif(shutil.which("objdump") is None, reason="needs objdump")
@pytest.mark.parametrize(("level", "unwanted"), [("v2", ("%ymm", "%zmm")), ("v3", ("%zmm",))])
def test_a_level_has_no_instructions_of_a_higher_one(level, unwanted, tmp_path):
    if platform.machine() != "x86_64":
        pytest.skip("levels of x86-64")
    made = compiled(tmp_path, level, "rs_localizer.core.bearings") / "kernels.o"
    command = ["objdump", "--disassemble", made]
    listed = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "%xmm" in listed.stdout
    assert not any(register in listed.stdout for register in unwanted)
