# The two commands that matter: `make demo` and `make test`. Both set up what they need, once.
# PYTHON=/path/to/python3.12 chooses the interpreter; otherwise the first of these that fits.
PYTHON ?= python3 python3.13 python3.12 python3.11
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
INSTALL := $(PIP) install --quiet --no-deps

.PHONY: help demo test fuzz bench tables lint format types check lock clean
.DELETE_ON_ERROR:

help:
	@echo 'make demo    set up, map a small generated recording, print the path of the picture'
	@echo 'make test    set up, run the tests'
	@echo 'make fuzz    read spoilt inputs of every kind for a minute; FUZZ="--seconds 3600 --seed 7"'
	@echo 'make bench   measure what docs/benchmarks.md holds; BENCH="--only PART" for parts of it'
	@echo 'make tables  compute what docs/results.md holds: a quarter of an hour, and twice that for the'
	@echo '             hard conditions, which TABLES_FLAGS= leaves out'
	@echo 'make check   lint, types and tests; each alone: make lint, make types, make test'
	@echo 'make format  put the code into the form that make lint asks for'
	@echo 'make lock    resolve the pinned versions again (LOCK_FLAGS=--upgrade: the newest)'
	@echo 'make clean   remove the environment and all caches; run folders stay'

demo: $(VENV)/.ready-to-run
	@$(BIN)/slam demo

# A file's tests stay in one process: they share fixtures that take long to make.
TEST_FLAGS ?= --numprocesses=auto --dist=loadfile
test: $(VENV)/.ready-to-develop
	@$(BIN)/python -m pytest $(TEST_FLAGS) $(TESTS)

# Any reader may be asked to read anything: what it may not do, tests/fuzz/__main__.py says.
fuzz: $(VENV)/.ready-to-develop
	@$(BIN)/python -m tests.fuzz $(FUZZ)

bench: $(VENV)/.ready-to-develop
	@$(BIN)/python -m slam.lab.benchmark $(BENCH)

# In processes of their own, one for each of two cores.
TABLES_FLAGS ?= --hard
tables: $(VENV)/.ready-to-run
	@$(BIN)/slam tables $(TABLES_FLAGS) --page docs/results.md

lint: $(VENV)/.ready-to-develop
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/lint-imports --no-cache

types: $(VENV)/.ready-to-develop
	@$(BIN)/mypy

check: lint types test

format: $(VENV)/.ready-to-develop
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

# ---- set-up ------------------------------------------------------------------------------------

# An environment made with another interpreter than the one asked for is made again.
PREFIX := -c 'import sys; print(sys.base_prefix)'
ifneq ($(origin PYTHON),file)
ifneq ($(shell $(PYTHON) $(PREFIX) 2>/dev/null),$(if $(wildcard $(BIN)/python),$(shell $(BIN)/python $(PREFIX))))
.PHONY: $(VENV)/pyvenv.cfg
endif
endif

# Exit codes: 3 wrong version, 4 no way to an environment, 5 only by way of the pip that is there
# (Debian and Ubuntu keep ensurepip in a package that takes root rights); others: does not start.
define FITS
import importlib.util, sys
has = importlib.util.find_spec
sys.stdout.write("%d.%d" % sys.version_info[:2])
if not (3, 11) <= sys.version_info[:2] <= (3, 13):
    sys.exit(3)
if has("venv") and has("ensurepip"):
    sys.exit(0)
sys.exit(5 if has("venv") and has("pip") else 4)
endef
export FITS

$(VENV)/pyvenv.cfg:
	@tried=; \
	for python in $(PYTHON); do \
	    version=$$("$$python" -c "$$FITS" 2>/dev/null); \
	    case $$? in \
	    0) echo "Making $(VENV) with $$python (Python $$version)"; \
	       exec "$$python" -m venv --clear $(VENV);; \
	    3) tried="$$tried  $$python is Python $$version; 3.11, 3.12 or 3.13 is needed\n";; \
	    5) echo "Making $(VENV) with $$python (Python $$version) and its pip, as it lacks ensurepip"; \
	       "$$python" -m venv --clear --without-pip $(VENV) || exit 1; \
	       exec "$$python" -m pip --python $(BIN)/python install --quiet pip;; \
	    4) tried="$$tried  $$python (Python $$version) lacks the module venv, or both ensurepip and pip; \
	on Debian and Ubuntu the package python$$version-venv has them\n";; \
	    *) tried="$$tried  $$python does not start\n";; \
	    esac; \
	done; \
	printf "No Python that can make the environment:\n$$tried" >&2; \
	printf 'Choose one: make PYTHON=/path/to/python3.12 ...\n' >&2; \
	exit 1

# A pinned version has a wheel for each supported Python, so nothing is compiled here.
# `pip check` finds out if a lock lacks something on this Python.
$(VENV)/.ready-to-run: $(VENV)/pyvenv.cfg requirements.lock pyproject.toml
	@echo 'Installing what a run needs (some 375 MB to download, once)'
	@$(INSTALL) --only-binary=:all: -r requirements.lock
	@$(INSTALL) --no-build-isolation -e .
	@$(PIP) check
	@touch $@

$(VENV)/.ready-to-develop: $(VENV)/pyvenv.cfg requirements-dev.lock pyproject.toml
	@echo 'Installing what a run and the tests need (some 420 MB to download, once)'
	@$(INSTALL) --only-binary=:all: -r requirements-dev.lock
	@$(INSTALL) --no-build-isolation -e .
	@$(PIP) check
	@touch $(VENV)/.ready-to-run $@

# Resolved with the oldest supported Python, whose packages are a superset of the others'.
LOCK_VENV := build/lock-venv
COMPILE = CUSTOM_COMPILE_COMMAND='make lock' $(LOCK_VENV)/bin/pip-compile --quiet $(LOCK_FLAGS) \
	--strip-extras --allow-unsafe --build-deps-for=editable --annotation-style=line --no-emit-options

lock:
	@$(MAKE) --no-print-directory $(LOCK_VENV)/pyvenv.cfg VENV=$(LOCK_VENV) PYTHON=python3.11
	@$(LOCK_VENV)/bin/python -m pip --disable-pip-version-check install --quiet pip-tools==7.6.2
	@$(COMPILE) --output-file=requirements.lock pyproject.toml
	@$(COMPILE) --extra=dev --constraint=requirements.lock \
		--output-file=requirements-dev.lock pyproject.toml
	@rm -rf $(LOCK_VENV)

clean:
	rm -rf $(VENV) build .pytest_cache .hypothesis .mypy_cache .ruff_cache .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
