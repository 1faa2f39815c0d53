# `make setup` builds .venv from the lock file; `make demo` and `make test` build on it.
# `make test-clients` builds .venv-clients, with RL code of others on top (docs/clients.md).
# `make docs` builds .venv-docs and, in site/, the documentation (docs/contributing.md).
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.locked
CLIENTS := .venv-clients
CLIENTS_STAMP := $(CLIENTS)/.locked
DOCS := .venv-docs
DOCS_STAMP := $(DOCS)/.locked
CHECK_PYTHON = $(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and f"Python 3.11 or newer is needed, found {v.major}.{v.minor}; try PYTHON=python3.11")'

.PHONY: setup demo loop test check-diagnosis test-clients docs lint lock uv dist check-wheel check-versions clean

setup: $(STAMP)

# --no-deps with hashes: exactly what the lock file names, nothing resolved again.
$(STAMP): requirements.lock pyproject.toml
	$(CHECK_PYTHON)
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-deps --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-deps --no-build-isolation --editable .
	touch $(STAMP)

demo: setup
	$(BIN)/python demo.py

# The loop from diagnosis to a better policy, on the shipped black box and five hidden plants: runs/loop/loop.md.
loop: setup
	$(BIN)/python -m benchmarks.loop

test: setup
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile

# Diagnoses 60 recorded plants again: names must stay and intervals agree to 1e-6; about 8 CPU minutes.
check-diagnosis: setup
	$(BIN)/python -m benchmarks.check_diagnosis

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

# The docstrings are read without importing them, so that the tools are all that is needed.
$(DOCS_STAMP): docs/requirements.lock
	$(CHECK_PYTHON)
	test -x $(DOCS)/bin/python || $(PYTHON) -m venv $(DOCS)
	$(DOCS)/bin/python -m pip install --disable-pip-version-check --quiet --no-deps --require-hashes -r docs/requirements.lock
	touch $(DOCS_STAMP)

# Not --quiet: MkDocs then counts no warnings.
docs: $(DOCS_STAMP)
	NO_MKDOCS_2_WARNING=1 $(DOCS)/bin/python -m mkdocs build --strict

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Rewrites the lock file from pyproject.toml, for every supported Python; needs uv in the environment.
lock: uv
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate \
		--no-header --extra train --extra sysid --extra viz --extra dev --output-file requirements.lock pyproject.toml
	$(BIN)/python -c 'import tomllib; print("\n".join(tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["docs"]))' \
		| $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-annotate \
		--no-header --output-file docs/requirements.lock -

# The next three need it; they build environments of their own.
uv: setup
	$(BIN)/python -m pip install --quiet uv

# dist/: the source distribution, and the wheel built from it.
dist: uv
	$(BIN)/uv build --quiet --clear --out-dir dist .

# Installs the wheel with each extra alone and uses it; runs the fast tests from the source distribution.
check-wheel: uv
	$(BIN)/python -m release.check_wheel

# Rewrites docs/results/versions.md: the fast tests with the newest and the oldest versions that are allowed.
check-versions: uv
	$(BIN)/python -m release.versions

clean:
	rm -rf $(VENV) $(CLIENTS) $(DOCS) .jax_cache site build dist *.egg-info
