# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Kernels: what Python may call them with, what becomes of the answer, and how they are built."""

import ctypes
import gc
import importlib
import os
import pickle
import platform
import shutil
import subprocess
import sys
import sysconfig
import typing
from pathlib import Path

import numpy as np
import pytest

from rs_localizer import native
from rs_localizer.core import so3
from rs_localizer.native import build, declared, sources
from rs_localizer.native.declared import ArrayOf, Scalar, TupleOf

JITTED = native.COMPILES


def entries():
    """All entries of the package by name: what Python calls."""
    for module in sources.kernel_modules():
        importlib.import_module(module)
    if not JITTED:
        return declared.FUNCTIONS
    from rs_localizer.native import jit

    return {name: entry.py_func for name, entry in jit.ENTRIES.items()}


def entry(name):
    module, _, function = name.rpartition(".")
    return getattr(sys.modules[module], function)


ENTRIES = entries()


def some(kind):
    """An argument that an entry takes by its declaration, as small as can be."""
    match kind:
        case Scalar(code):
            return {"d": 0.5, "q": 1, "?": True}[code]
        case ArrayOf(element, dimensions):
            return np.zeros((1,) * dimensions, element)
        case TupleOf(fields, named):
            return (named or (lambda *parts: parts))(*map(some, fields))


def faults_of(kind):
    """Arguments that an entry must refuse instead, and a word of what it says."""
    match kind:
        case Scalar("d"):
            yield from [(1, "a float"), (np.float32(1.0), "a float"), (None, "a float")]
        case Scalar("q"):
            yield from [(1.0, "an int"), (True, "an int"), (2**63, "an int"), ("1", "an int")]
        case Scalar():
            yield from [(1, "a bool"), (np.float64(1.0), "a bool")]
        case ArrayOf(element, dimensions, is_written):
            other = "float32" if element == "float64" else "float64"
            yield np.zeros((1,) * dimensions, other), element
            yield np.zeros((1,) * (dimensions + 1), element), f"{dimensions} dimensions"
            every_second = (slice(None, None, 2),) * dimensions
            yield np.zeros((4,) * dimensions, element)[every_second], "contiguous"
            yield [0.0], "a contiguous array"
            size = np.dtype(element).itemsize
            if size > 1:
                raw = np.zeros(size + 1, np.uint8)[1:].view(element)
                yield raw.reshape((1,) * dimensions), "not aligned"
            if is_written:
                fixed = np.zeros((1,) * dimensions, element)
                fixed.flags.writeable = False
                yield fixed, "can be written to"
        case TupleOf(fields, named):
            yield 1, named.__name__ if named else "a tuple"
            parts = tuple(map(some, fields))
            yield parts[:-1], named.__name__ if named else "a tuple"
            if named is not None:
                yield parts, named.__name__
            for k, field in enumerate(fields):
                for fault, word in faults_of(field):
                    replaced = (*parts[:k], fault, *parts[k + 1 :])
                    yield (named._make(replaced) if named else replaced), word


@pytest.mark.parametrize("name", sorted(ENTRIES))
def test_an_entry_refuses_what_it_does_not_declare(name):
    said = declared.declaration(ENTRIES[name])
    arguments = [some(kind) for kind in said.arguments.values()]
    with pytest.raises(TypeError, match=f"takes {len(arguments)} arguments"):
        entry(name)(*arguments, 1.0)
    for k, (argument, kind) in enumerate(said.arguments.items()):
        for fault, word in faults_of(kind):
            with pytest.raises(TypeError) as refused:
                entry(name)(*arguments[:k], fault, *arguments[k + 1 :])
            text = str(refused.value)
            assert text.startswith(f"{name}: {argument}"), text
            assert word in text, text
            assert "got" in text


def test_a_kernel_that_is_no_entry_is_not_called():
    with pytest.raises(TypeError, match=r"so3\.coefficients is called by kernels alone"):
        so3.coefficients(0.1)


def test_a_read_only_array_is_taken_where_nothing_is_written():
    vector = np.array([0.1, 0.2, 0.3])
    expected = so3.exp(vector)
    vector.flags.writeable = False
    np.testing.assert_array_equal(so3.exp(vector), expected)


def test_refusals_do_not_leak():
    held = np.zeros(3, np.float32)
    before = sys.getrefcount(held)
    for _ in range(100):
        with pytest.raises(TypeError):
            so3.exp(held)
    gc.collect()
    assert sys.getrefcount(held) == before


@pytest.mark.skipif(JITTED, reason="of the native module")
def test_an_entry_is_pickled_by_its_name():
    again = pickle.loads(pickle.dumps(so3.exp))
    np.testing.assert_array_equal(again(np.ones(3)), so3.exp(np.ones(3)))
    assert "core.so3.exp" in repr(so3.exp.__self__)


class Pair(typing.NamedTuple):
    one: float
    two: "np.ndarray"


def odd(x: np.ndarray) -> None: ...
def pair(x: Pair) -> None: ...
def defaults(x: float = 0.0) -> None: ...


@pytest.mark.parametrize(
    ("function", "said"),
    [(odd, "x: .*says too little"), (pair, "x: .*says too little"), (defaults, "neither defaults")],
)
def test_an_annotation_that_says_too_little_is_refused(function, said):
    with pytest.raises(TypeError, match=said):
        declared.declaration(function)


@pytest.mark.parametrize(
    ("cap", "said"),
    [("v9", "'v9'; this machine's levels are v2, v3, v4"), ("generic", "levels are")],
)
def test_a_level_that_is_none_is_refused_in_a_line(cap, said):
    environment = os.environ | {"RS_LOCALIZER_LEVEL": cap}
    environment.pop("RS_LOCALIZER_KERNELS", None)
    code = "from rs_localizer.core import so3"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment
    )
    assert done.returncode != 0
    assert said in done.stderr.splitlines()[-1]


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
