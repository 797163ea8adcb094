# Everything from a fresh clone with python3 (3.10 to 3.13), make and the package index.

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
export OMP_NUM_THREADS ?= 1

# The first interpreter that can build the environment; `make setup PYTHON=...` chooses another.
SUITS := import sys, venv, ensurepip; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))
CANDIDATES := python3 python3.12 python3.13 python3.11 python3.10
PYTHON ?= $(firstword $(foreach name,$(CANDIDATES),$(shell $(name) -c '$(SUITS)' >/dev/null 2>&1 && echo $(name))))

.PHONY: setup test lint demo clean

setup: $(STAMP)

$(STAMP): setup.py setup.cfg Makefile
	@test -x $(BIN)/python || test -n "$(PYTHON)" || \
	    { echo 'make: no python3 of version 3.10 to 3.13 with the venv module was found (make setup PYTHON=...)' >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade pip 'setuptools<80' wheel
	@# setuptools warns of the source tree in every editable installation
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[test,dask]'
	@touch $@

lint: setup
	$(BIN)/ruff check .
	$(BIN)/mypy

test: lint
	$(BIN)/python -m pytest -n 2 --dist loadfile $(PYTEST)

demo: setup
	@$(BIN)/python -m semiparam_ros.cli.demo

clean:
	rm -rf $(VENV) build install log output *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
