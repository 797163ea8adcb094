# Everything from a fresh clone with python3 (3.10 to 3.13), make and the package index.

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
export OMP_NUM_THREADS ?= 1
# With it each of the hundreds of processes that the tests start would compile the package's sources anew.
unexport PYTHONDONTWRITEBYTECODE

# The first interpreter that can build the environment; `make setup PYTHON=...` chooses another.
SUITS := import sys, venv, ensurepip; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))
CANDIDATES := python3 python3.12 python3.13 python3.11 python3.10
PYTHON ?= $(firstword $(foreach name,$(CANDIDATES),$(shell $(name) -c '$(SUITS)' >/dev/null 2>&1 && echo $(name))))

.PHONY: setup test suite test-long coverage oldest lint docs demo clean

setup: $(STAMP)

$(STAMP): pyproject.toml setup.py setup.cfg Makefile
	@test -x $(BIN)/python || test -n "$(PYTHON)" || \
	    { echo 'make: no python3 of version 3.10 to 3.13 with the venv module was found (make setup PYTHON=...)' >&2; exit 1; }
	@echo 'Installing into $(VENV) (once): numerics, ROS 2 and tools, from the package index.'
	@echo 'This takes two to five minutes, by the network; nothing else is printed meanwhile.'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade pip 'setuptools<80' wheel
	@# setuptools warns of the source tree in every editable installation
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation \
	    --editable '.[test,dask,docs]'
	@touch $@

lint: setup
	$(BIN)/ruff check .
	$(BIN)/mypy

test: setup
	@$(MAKE) --no-print-directory --jobs=2 lint suite docs

# The longest files first: begun last, they would run alone.
PYTEST ?= test/test_docs.py test/diagnosis/test_diagnosis.py test/ros/test_outside_faults.py test

# Three at a time on two cores: tests of live nodes mostly wait. What numba compiles is compiled once before, not by each.
suite: setup
	$(BIN)/python -c 'import semiparam_ros.diagnosis.diagnose, semiparam_ros.ros.estimator.node'
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder $(PYTEST)

# Each test in its long form, hours of two cores: ten minutes of bad messages, every pair of settings with 20000 samples,
# hundreds of random lives. PYTEST='-s test/ros/test_node_fuzz.py' takes one file, and shows what it counted.
test-long: setup
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --long $(PYTEST)

# The whole suite again, with the lines and branches that it reaches, those in other processes among them.
coverage: setup
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder --cov --cov-report=term $(PYTEST)

# The oldest versions that pyproject.toml allows, in an environment of their own. pip would not choose a numpy before 2,
# because pin's wheels declare none; Ubuntu 24.04 has one beside its own pinocchio, and the wheels work with it.
OLDEST := .venv-oldest
OLDEST_TESTS := alignment or bags or columns or convert or effects or estimator or marginal_likelihood or horizon or differentiation or \
    layers or model or optional or public or random_features or recursion or rigid_body or cdr or settings or \
    simulation or smoothing or structure or terms or square_root_filter
# python3.10 on the path, or pyenv's; uv fetches one where there is neither.
OLDEST_PYTHON ?= $(or $(shell python3.10 -c 'import sys; print(sys.executable)' 2>/dev/null),\
    $(lastword $(wildcard $(HOME)/.pyenv/versions/3.10.*/bin/python)),3.10)
oldest: setup
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(BIN)/uv venv --quiet --clear --seed --python $(strip $(OLDEST_PYTHON)) $(OLDEST)
	echo 'numpy>=1.26,<2' >$(OLDEST)/overrides.txt
	$(BIN)/uv pip install --quiet --python $(OLDEST)/bin/python --overrides $(OLDEST)/overrides.txt \
	    --resolution lowest-direct --requirements pyproject.toml --extra rosbags
	$(BIN)/uv pip install --quiet --python $(OLDEST)/bin/python --overrides $(OLDEST)/overrides.txt \
	    pytest pytest-timeout hypothesis idyntree mujoco tomli
	$(BIN)/uv pip list --quiet --python $(OLDEST)/bin/python --exclude-editable | grep -Ev '^(ros-|cmeel)'
	PYTHONPATH=. $(OLDEST)/bin/python -m pytest --quiet -p no:cacheprovider -m 'not slow' \
	    -k '($(strip $(OLDEST_TESTS))) and not node and not interop and not counterparts' $(PYTEST)

# The documentation as a site: output/docs/index.html. A broken link or reference ends it.
docs: setup
	$(BIN)/python -m sphinx -W --keep-going -n -q -b html docs output/docs

demo: setup
	@$(BIN)/python -m semiparam_ros.cli.demo

clean:
	rm -rf $(VENV) $(OLDEST) .coverage* build install log output *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
