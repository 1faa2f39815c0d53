# `make setup` builds .venv from the lock file; `make demo` and `make test` build on it.
# `make test-clients` builds .venv-clients, with RL code of others on top (docs/clients.md).
# `make docs` builds the documentation into site/.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.locked
CLIENTS := .venv-clients
CLIENTS_STAMP := $(CLIENTS)/.locked
CHECK_PYTHON = $(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and f"Python 3.11 or newer is needed, found {v.major}.{v.minor}; try PYTHON=python3.11")'

.PHONY: setup demo loop test test-all test-clients docs lint lock dist check-wheel check-versions clean

setup: $(STAMP)

# --no-deps with hashes: exactly what the lock file names, nothing resolved again.
$(STAMP): requirements.lock pyproject.toml
	$(CHECK_PYTHON)
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "Installing what requirements.lock names; pip says nothing for some minutes."
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-deps --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-deps --no-build-isolation --editable .
	touch $(STAMP)

demo: setup
	$(BIN)/python demo.py

# The loop from diagnosis to a better policy, on the shipped black box and five hidden plants: runs/loop/loop.md.
loop: setup
	$(BIN)/python -m benchmarks.loop

# The fast tests: every capability once. In their order the longest come first, so both workers end together.
test: setup
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder -m "not slow"

# The rest: statistics, long trainings, every tutorial.
test-all: setup
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile -m slow -rs

# With dependencies: what the clients need beyond the lock file is in their requirements.
$(CLIENTS_STAMP): requirements.lock clients/requirements.txt pyproject.toml
	$(CHECK_PYTHON)
	test -x $(CLIENTS)/bin/python || $(PYTHON) -m venv $(CLIENTS)
	$(CLIENTS)/bin/python -m pip install --disable-pip-version-check --quiet --no-deps --require-hashes -r requirements.lock
	$(CLIENTS)/bin/python -m pip install --disable-pip-version-check --quiet -r clients/requirements.txt
	$(CLIENTS)/bin/python -m pip install --disable-pip-version-check --quiet --no-deps --no-build-isolation --editable .
	$(CLIENTS)/bin/python -m pip check
	touch $(CLIENTS_STAMP)

test-clients: $(CLIENTS_STAMP)
	$(CLIENTS)/bin/python -m pytest clients

docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Rewrites the lock file from pyproject.toml, for every supported Python.
lock: setup
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate \
		--no-header --extra train --extra sysid --extra viz --extra dev --extra docs \
		--output-file requirements.lock pyproject.toml

# dist/: the source distribution, and the wheel built from it.
dist: setup
	$(BIN)/uv build --quiet --clear --out-dir dist .

# Installs the wheel with each extra alone and uses it; runs tests from the source distribution.
check-wheel: setup
	$(BIN)/nox --tags wheel

# Runs the unit tests with the oldest and the newest versions that are allowed.
check-versions: setup
	$(BIN)/nox --tags versions

clean:
	rm -rf $(VENV) $(CLIENTS) .nox site build dist *.egg-info
