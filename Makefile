# The commands a newcomer needs.  Each sets up what it lacks the first time: a virtual
# environment, the packages of requirements.lock, and an LLVM that Mitsuba can use.

PYTHON ?= python3
PHOTOGRAPHS ?=
PYTEST ?=
NAME ?=
BIN := .venv/bin
ROOT := $(shell [ "$$(id -u)" = 0 ] || echo sudo -n)
MINUTES ?= 10
OLDEST ?= $(addprefix tests/lscan/,files config camera live surface/test_stack.py \
	cli/test_commands.py cli/test_measure_command.py)
# The newest Python that requirements.lock is for, as its head says: the 14 of "3.11 to 3.14".
NEWEST := $(shell sed -n '1,3s/.*3\.[0-9]* to 3\.\([0-9]*\).*/\1/p' requirements.lock)
APT := $(ROOT) env DEBIAN_FRONTEND=noninteractive apt-get -qq

.PHONY: help setup demo test test-all pytest mutants validate soak lint house oldest suites tables docs clean
.DELETE_ON_ERROR:

help:
	@echo "make setup   set up what the others need: .venv, its packages, LLVM"
	@echo "make demo    scan the tank once and write out/demo"
	@echo "make test    all checks and the tests that are quick: minutes"
	@echo "make test-all  all checks, all tests with all their examples, and the mutants"
	@echo "make pytest  the tests alone; PYTEST='-m \"not slow\"' is handed to pytest"
	@echo "make mutants faults put into the code one by one, each of which a quick test must notice"
	@echo "make soak    property tests with random examples for MINUTES=10, or as many as named"
	@echo "make house   sizes of packages and README, names used twice, each with its bar"
	@echo "make oldest  tests of the instrument and a render with the oldest packages allowed; out/oldest"
	@echo "make lint    the checks alone: ruff, mypy, import contracts"
	@echo "make validate  hold tank and instrument to their figures; out/validate/report.html."
	@echo "             NAME=light (or instrument, surfaces, robustness, intervals, studies, regression,"
	@echo "             roughness, speed) measures one theme, QUICK=1 all with the least effort"
	@echo "make suites  render the suites quick and chains and pack the wheel of them; out/dist"
	@echo "make tables  make the tables of scattered light that are shipped"
	@echo "make docs    build the documentation, its pages' code included; out/docs/index.html"
	@echo "make clean   remove all that was set up or made, save runs/"

setup: .venv/llvm.stamp

demo: .venv/llvm.stamp
	$(BIN)/lscan-sim demo -o out/demo

# The checks use one core while tests wait for devices and browsers.
test: .venv/chromium.stamp
	@$(MAKE) --no-print-directory -j 2 lint pytest PYTEST='-m "not slow" $(PYTEST)'

test-all: .venv/chromium.stamp
	@$(MAKE) --no-print-directory -j 2 lint pytest PYTEST='--hypothesis-profile=full $(PYTEST)'
	@$(MAKE) --no-print-directory mutants

mutants: .venv/llvm.stamp
	$(BIN)/python -m tests.mutants $(NAME)

pytest: .venv/llvm.stamp .venv/chromium.stamp
	$(BIN)/python -m pytest -n auto --maxprocesses 8 --dist loadgroup $(PYTEST)

lint: .venv/packages.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Stops at the first round that fails; it has said the seed and the example.
soak: .venv/llvm.stamp
	$(BIN)/python tests/support/soak.py $(MINUTES)

house: .venv/packages.stamp
	$(BIN)/python tests/support/house.py

# What pyproject.toml promises: all lower bounds at once, in an environment of their own.
oldest: export LSCAN_PHOTONS ?= 131072
oldest: .venv/llvm.stamp
	rm -rf out/oldest
	$(BIN)/python -m venv out/oldest
	$(BIN)/python tests/support/oldest.py >out/oldest/constraints.txt
	out/oldest/bin/python -m pip install --quiet --disable-pip-version-check --only-binary :all: \
		--no-compile -c out/oldest/constraints.txt setuptools
	out/oldest/bin/python -m pip install --quiet --disable-pip-version-check --only-binary :all: \
		--no-compile -c out/oldest/constraints.txt --no-build-isolation --editable '.[tank,docs,dev]'
	out/oldest/bin/python -m pytest -q -m "not slow" $(OLDEST)
	out/oldest/bin/lscan-sim demo --quick -o out/oldest/demo

# Every theme, or NAME=... of them; the rows of real photographs need PHOTOGRAPHS=FOLDER.
ifdef QUICK
validate: export LSCAN_PHOTONS ?= 131072
endif
validate: .venv/llvm.stamp .venv/chromium.stamp
	$(BIN)/python -m tests.validation $(NAME) $(if $(QUICK),--quick) $(if $(FULL),--full) \
		$(if $(PHOTOGRAPHS),--photographs "$(PHOTOGRAPHS)") -o out/$(if $(QUICK),quick,validate)

suites: .venv/llvm.stamp
	$(BIN)/lscan-sim suite make quick -o out/suites/quick.zip
	$(BIN)/lscan-sim suite make chains -o out/suites/chains.zip
	$(BIN)/lscan suite wheel out/suites/quick.zip out/suites/chains.zip -o out/dist

tables: .venv/llvm.stamp
	$(BIN)/python tests/support/ship_spreads.py

docs: .venv/llvm.stamp
	$(BIN)/python -m sphinx -W --keep-going -n -q docs out/docs

clean:
	rm -rf .venv out build dist *.egg-info
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find lscan sim tests -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/llvm.stamp: .venv/packages.stamp
	@$(BIN)/python -m sim.render.backend --install
	@touch $@

# The live page is tested in a browser; where none can be had, those tests say so and skip.
# After LLVM, not beside it: both may call apt-get, which runs once at a time.
.venv/chromium.stamp: .venv/packages.stamp | .venv/llvm.stamp
	@$(BIN)/python -m tests.validation.browser --install
	@touch $@

.venv/packages.stamp: .venv/python.stamp requirements.lock pyproject.toml
	@echo "installing the packages of requirements.lock into .venv (a minute or two)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --only-binary :all: \
		--no-compile --require-hashes -r requirements.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps \
		--no-build-isolation --editable .
	@# By all cores, which pip does by one; some packages hold files of other versions of Python.
	@$(BIN)/python -W ignore -m compileall -qq -j 0 -x '/tests/' .venv/lib || true
	@# What numba compiles it keeps beside the module, once for all processes that follow.
	@echo "compiling what reads pictures (half a minute)"
	@$(BIN)/python -c "from lscan.pipeline import compile_loops; compile_loops()"
	@touch $@

# A bare Debian or Ubuntu has Python without the part that makes virtual environments.
.venv/python.stamp:
	@command -v "$(PYTHON)" >/dev/null || \
		{ echo "lscan needs Python 3.11 or newer: there is no $(PYTHON)" >&2; exit 2; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "lscan needs Python 3.11 or newer: $(PYTHON) is $$("$(PYTHON)" -V 2>&1)," \
		"name another one, as in: make test PYTHON=python3.11" >&2; exit 2; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info >= (3, $(NEWEST) + 1))' || \
		echo "note: requirements.lock is for Python 3.11 to 3.$(NEWEST): where a package of it has" \
		"nothing for $$("$(PYTHON)" -V 2>&1), name another, as in: make test PYTHON=python3.11" >&2
	@"$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || { \
		package="$$("$(PYTHON)" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')"; \
		echo "installing $$package"; \
		$(APT) install -y $$package || { $(APT) update && $(APT) install -y $$package; } || \
		{ echo "$(PYTHON) cannot make virtual environments: install the package $$package" >&2; \
		exit 2; }; }
	@"$(PYTHON)" -m venv .venv
	@touch $@
