# Recipes for people and for CI. Needs make, a POSIX shell, Python 3.11 or later and a package registry; the compiled
# build also a C compiler. Everything lands inside the checkout: .venv/, build/, results/ and caches.

PYTHON ?= python3
WORKERS ?= 2

VENV := .venv
BIN := $(VENV)/bin
# Written last, with the place it was made for: a virtual environment knows its own path and must not be moved.
READY := $(VENV)/.set-up-complete
STARTED := $(VENV)/.set-up-started
RECENT := import sys; sys.exit(sys.version_info < (3, 11))

# A part of the tests says which ones it skipped and why, and leaves a report for the last lines of `make test`.
PYTEST := $(BIN)/python -m pytest -rs
REPORTS := build/reports
THIS_MAKE := $(MAKE) # by another name, so that `make -n` does not run it

# What a user's shell has set must not reach into the virtual environment.
unexport PYTHONPATH PYTHONHOME PYTHONSTARTUP PYTHONOPTIMIZE PYTHONDONTWRITEBYTECODE PIP_USER PIP_TARGET PIP_PREFIX PIP_REQUIRE_VIRTUALENV
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export MPLCONFIGDIR := $(CURDIR)/.cache/matplotlib

ifneq ($(wildcard $(READY)),)
ifneq ($(shell cat $(READY)),$(CURDIR))
MOVED := moved
endif
endif

.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: help setup demo test lint unit runs realtime vcan compile bench soak paper lock clean moved

help: ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-8s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(READY) ## .venv with the pinned packages and this project (once; again when the pins change)

$(READY): requirements.lock pyproject.toml $(MOVED)
	@$(PYTHON) -c '$(RECENT)' || { \
	  echo "make: PYTHON=$(PYTHON) is `$(PYTHON) --version 2>&1`; needed is Python 3.11 or later: make PYTHON=python3.11" >&2; \
	  exit 1; }
	@if [ -e $(STARTED) ] || [ -n "$(MOVED)" ] || { [ -e $(BIN)/python ] && ! $(BIN)/python -c '$(RECENT)'; } \
	  || { [ -h $(BIN)/python ] && [ ! -e $(BIN)/python ]; }; then \
	  echo "make: $(VENV) is incomplete, moved or broken: starting it afresh"; rm -rf $(VENV); fi
	@mkdir -p $(VENV) && : > $(STARTED) && rm -f $(READY)
	@[ -x $(BIN)/python ] || $(PYTHON) -m venv $(VENV)
	@echo "make: installing the packages of requirements.lock into $(VENV)"
	@$(BIN)/python -m pip install --quiet --require-hashes -r requirements.lock
	@$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation -e .
	@$(BIN)/python -m pip check
	@printf '%s' "$(CURDIR)" > $(READY) && rm -f $(STARTED)

demo: $(READY) ## a frozen knee encoder, with its verdict (pass and fail are both a success of the demonstration)
	@rm -rf results/demo; status=0; \
	$(BIN)/exo-hil run scenarios/knee_freeze.yaml --out results/demo || status=$$?; \
	[ $$status -le 1 ] || exit $$status; \
	$(BIN)/python -c 'import json; print("verdict:", json.load(open("results/demo/summary.json"))["verdict"])' && \
	echo "traces and plots: results/demo"

test: $(READY) ## all of the next six, whatever fails on the way; says last what failed, how many were skipped, and why
	@$(BIN)/python -m tests.recipes $(THIS_MAKE) $(REPORTS)

lint: $(READY) ## ruff, mypy --strict, import contracts
	$(BIN)/python -m ruff check .
	$(BIN)/python -m mypy
	$(BIN)/lint-imports --no-logo

unit: $(READY) ## the tests that need no whole run and no clock, on WORKERS=2 processes
	$(PYTEST) -n $(WORKERS) -m "not run and not long and not realtime" --ignore=tests/vcan --junitxml=$(REPORTS)/$@.xml

runs: $(READY) ## whole runs in virtual time, the examples, and laws that take long, on WORKERS=2 processes
	$(PYTEST) -n $(WORKERS) --dist loadfile -m "run or long" --ignore=tests/vcan --junitxml=$(REPORTS)/$@.xml

realtime: $(READY) ## rigs of processes against the clock, one at a time, on the hub; a machine too busy for them skips
	$(PYTEST) -m realtime --ignore=tests/vcan --junitxml=$(REPORTS)/$@.xml

vcan: $(READY) ## tests on a real SocketCAN: vcan where the kernel has it, else User Mode Linux (a Debian package, fetched)
	$(PYTEST) tests/vcan --junitxml=$(REPORTS)/$@.xml

compile: $(READY) ## the core compiled with mypyc must give the same traces (skipped, saying why, without a C compiler)
	$(BIN)/python benchmarks/compile_core.py

bench: $(READY) ## measured ratios against the budgets; nothing is asserted
	@found=0; for file in benchmarks/bench_*.py; do \
	  if [ -e "$$file" ]; then found=1; $(BIN)/python "$$file" || exit $$?; fi; done; \
	[ $$found = 1 ] || { echo "make: there is no benchmarks/bench_*.py" >&2; exit 1; }

soak: $(READY) ## ten million frames through the gateway, then a full bus: none lost, doubled, changed or out of order
	$(BIN)/python -m benchmarks.soak

paper: $(READY) ## the campaigns of docs/paper.md, and its tables from them (how long: there); goes on where it was
	@run() { echo "campaign run $$*"; $(BIN)/exo-hil campaign run "$$@" || [ $$? = 3 ]; }; to=results/campaigns; set -e; \
	run campaigns/rmse_over_duration.yaml --out $$to/rmse_over_duration.sqlite; \
	run campaigns/rmse_over_duration.yaml --out $$to/rmse_over_duration-pins.sqlite --set rig.stops=on --runs 10; \
	run campaigns/compensated.yaml --out $$to/compensated.sqlite; \
	run campaigns/compensated.yaml --out $$to/compensated-pins.sqlite --set rig.stops=on; \
	run campaigns/critical_duration.yaml --out $$to/critical_duration.sqlite; \
	run campaigns/small_faults.yaml --out $$to/small_faults.sqlite; \
	run campaigns/small_faults.yaml --out $$to/small_faults-pins.sqlite --set rig.stops=on; \
	run campaigns/bit_flips.yaml --out $$to/bit_flips.sqlite
	$(BIN)/python -m testbench.campaign.report.markdown docs/paper.md

lock: ## for maintainers: newest versions allowed by pyproject.toml into requirements.lock, for all platforms
	@rm -rf build/lock && $(PYTHON) -m venv build/lock && build/lock/bin/python -m pip install --quiet uv
	build/lock/bin/uv pip compile --quiet --upgrade --universal --fork-strategy fewest --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-annotate --no-header --extra sim --extra dev -o build/lock/requirements.lock pyproject.toml
	@if grep -n '://' build/lock/requirements.lock; then echo "make: an address got into the lock file" >&2; exit 1; fi
	@mv build/lock/requirements.lock requirements.lock && rm -rf build/lock

clean: ## remove build products and caches; keeps .venv and results
	rm -rf build dist .cache .mypy_cache .ruff_cache .import_linter_cache .pytest_cache .hypothesis
	find canopen_exo joint_emulators hlc fi_gateway testbench dbc tests benchmarks examples -name __pycache__ -prune -exec rm -rf {} +
