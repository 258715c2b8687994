# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
#
# make demo   the whole thing on the bundled recording: a table on the screen, a picture in out/
# make test   lint, types and tests
# make kernels  compiles what has been edited of the kernels; the others do that first
# make wheel  wheels for other machines, in dist/
# make levels what `make wheel` has made, each level against what `make jit` kept, aarch64 by qemu
# make jit    the kernels' own tests under Numba, and the native module against what they gave
# make bench  the statistical tests, which take longer: coverage of regions, verdicts of experiments
# make coverage  the tests once more, and which lines they run: without kernels, and
#                without what runs in processes of its own (nodes, some commands); COVERAGE is
#                what pytest is told instead, as by .ci/run
# make docs   the pages as a site, in out/docs; a link that leads nowhere is an error
# make ros    the package as a workspace of an installed ROS 2 has it: launch files, tf2, life cycle,
#             bags; fetches nothing, and says so where there is no ROS
# make release  checks what a release needs, and prints what a person still has to do
# make clean  removes everything that make has made
#
# Both prepare a virtual environment first (once). PYTHON chooses the interpreter, VENV the place.

VENV ?= .venv
OUT ?= out
# What `make jit` runs: tests that call kernels.
JIT ?= test/core test/solvers test/estimation test/inertial test/matching test/markers test/native \
    test/tools/adjust/test_factors.py test/tools/simulation/test_rendering.py
COVERAGE ?= --cov

# The first interpreter that will do; without any, python3 is refused below with the reason.
supported = import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))
ifndef PYTHON
PYTHON := $(shell for p in python3 python3.14 python3.13 python3.12 python3.11; do \
    $$p -c '$(supported)' 2>/dev/null && echo $$p && exit; done; echo python3)
endif

# The environment is sealed: ROS wheels from pip and an installed ROS do not mix in one process.
ifdef AMENT_PREFIX_PATH
unexport LD_LIBRARY_PATH
endif
unexport AMENT_PREFIX_PATH PYTHONPATH PYTHONHOME RMW_IMPLEMENTATION
# Some two hundred processes of the tests would compile all of the package's Python again.
unexport PYTHONDONTWRITEBYTECODE
# By this the ROS wheels of another environment would say that the library path is already set.
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE

# One stamp per interpreter, so that another PYTHON makes a new environment.
ready := $(VENV)/.ready-$(subst /,_,$(PYTHON))
python := $(VENV)/bin/python
# What takes long says what it does, a line at least every 20 s.
progress := $(PYTHON) .ci/progress.py
# The processor that Numba compiles for, as the native module was: see rs_localizer/native/build.py.
native = $$($(python) -m rs_localizer.native.build --environment)
pip := $(python) -m pip install --disable-pip-version-check --no-input --progress-bar off

.PHONY: demo test bench ros coverage docs collect kernels wheel levels jit lint release clean
.DELETE_ON_ERROR:

demo: kernels
	@$(python) -m rs_localizer demo --out $(OUT)

# Of four processes one or two often wait, for nodes that have to hear of each other. Threads of BLAS
# would wait for each other, too, and spin: 119 s of the processor instead of 26 in one file.
test: $(ready)
	@$(MAKE) --no-print-directory kernels
	@$(MAKE) --no-print-directory --jobs 2 lint collect
	@OPENBLAS_NUM_THREADS=1 $(python) -m pytest -q -n 4 --dist loadfile

bench: kernels
	@OPENBLAS_NUM_THREADS=1 $(python) -m pytest -q -n 2 --dist loadfile -m bench

coverage: kernels
	@$(progress) --quiet coverage $(pip) --upgrade --no-deps --target $(VENV)/coverage coverage pytest-cov
	@PYTHONPATH="$$(cd $(VENV) && pwd)/coverage" OPENBLAS_NUM_THREADS=1 \
	    $(python) -m pytest -q -n 2 --dist loadfile --cov-report term:skip-covered $(COVERAGE)

# In the environment of ROS, which the line above has taken away.
ros:
	@[ -n "$$ROS_DISTRO" ] || { echo "make ros: skipped, ROS 2 is not installed here (source its setup.sh)"; exit 0; }; \
	. "/opt/ros/$$ROS_DISTRO/setup.sh" && colcon --log-base $(OUT)/ros/log build \
	    --packages-select rs_localizer --build-base $(OUT)/ros/build --install-base $(OUT)/ros/install && \
	. $(OUT)/ros/install/setup.sh && ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST python3 -m pytest -q -rs test/real_ros

docs: $(ready)
	@$(progress) --quiet docs $(pip) --no-build-isolation --editable '.[docs]'
	@$(progress) docs $(python) -m sphinx -q -W --keep-going -c docs . $(OUT)/docs
	@echo $(OUT)/docs/README.html

# Leaves the tests with their assertions rewritten, which each of the processes would do.
collect: $(ready)
	@$(progress) --quiet "collecting tests" $(python) -m pytest -q --collect-only

# Compiles what has been edited since: nothing, mostly. Objects are kept in .kernels.
kernels: $(ready)
	@$(progress) "compiling kernels" $(python) -m rs_localizer.native.build

# Wheels for all levels of x86-64 and for aarch64, on Linux since glibc 2.28, in dist/.
wheel: $(ready)
	@$(progress) --quiet "installing packages" $(pip) build ziglang auditwheel
	@bash .ci/portable_wheels dist

release:
	@bash .ci/release

# The kernels of other processors, too, which a wheel has and nobody here runs.
levels: jit wheel
	@bash .ci/levels dist $(VENV)/calls.pkl

# The kernels under Numba: their own tests, and whether the native module answers as they do.
jit: kernels
	@env RS_LOCALIZER_KERNELS=numba RS_LOCALIZER_CALLS=$(VENV)/calls.pkl PYTHONPATH=test/native \
	    $(native) OPENBLAS_NUM_THREADS=1 $(progress) "running kernels by Numba" \
	    $(python) -m pytest -q -p recorder $(JIT)
	@$(python) test/native/compare.py $(VENV)/calls.pkl

lint: $(ready)
	@$(progress) "linting" $(python) -m ruff check --quiet --output-format concise .
	@$(progress) "checking the format" $(python) -m ruff format --quiet --check .
	@$(progress) "checking the spelling" $(python) -m codespell_lib
	@$(progress) "checking notices" $(python) .ci/notices.py
	@$(progress) "checking types" $(python) -m mypy --no-error-summary

$(ready): setup.py pyproject.toml Makefile
	@$(PYTHON) -c '$(supported)' 2>/dev/null || { \
	    echo "rs_localizer needs Python 3.11, 3.12, 3.13 or 3.14, but $(PYTHON) is" \
	        "$$($(PYTHON) -V 2>/dev/null || echo 'not there')." \
	        "Choose another with: make PYTHON=/path/to/python3.12" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	    echo "$(PYTHON) cannot make virtual environments." \
	        "On Debian and Ubuntu: sudo apt install python3-venv" >&2; exit 1; }
	@echo "Preparing $(VENV) (once, takes a few minutes)"
	@[ -e $@ ] || $(progress) "making the environment" $(PYTHON) -m venv --clear $(VENV)
	@$(progress) --quiet "installing build tools" $(pip) $$($(python) .ci/build_requires.py)
	@$(progress) "compiling kernels" $(python) -m rs_localizer.native.build
	@$(progress) --quiet "installing packages" $(pip) --no-compile --no-build-isolation \
	    --editable '.[ros,tools,evaluate,fleet,examples,mapping,table,video,test]'
	@# Which pip does one file after the other, and the tests of other packages with them.
	@$(progress) --quiet "compiling packages" $(python) -m compileall -j 0 -x '/(tests|pip)/' $(VENV)/lib 2>/dev/null || true
	@touch $@

clean:
	rm -rf $(VENV) $(OUT) .kernels build dist install log *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis .coverage
	rm -f rs_localizer/native/*.so rs_localizer/native/_kernels_*.json
	find rs_localizer benchmarks test -name __pycache__ -type d -prune -exec rm -rf {} +
