# The whole interface: `make` lists it. CI calls `make test` and nothing else.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

TIMESTEPS ?= 250000
ENV ?= Humanoid-v5
SEED ?= 0
RESOLVER ?= gcr

.DEFAULT_GOAL := help
.PHONY: help install train test test-mjlab check format pytest bench doc build lower clean

help:  ## list the commands
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 18

install: $(VENV)/installed  ## make the environment in .venv

$(VENV)/installed: setup.cfg pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "sb3_gcr needs Python 3.10 or newer: '$(PYTHON)' was not found. Install it, or name it: make PYTHON=/path/to/python3"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { echo "sb3_gcr needs Python 3.10 or newer, found $$($(PYTHON) --version). Name another: make PYTHON=/path/to/python3"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "sb3_gcr needs pip and venv for $(PYTHON), and they are missing. On Debian and Ubuntu: apt install python3-pip python3-venv"; exit 1; }
	@echo "== making the environment in $(VENV) (a few minutes the first time)"
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[plots,torchjd,envpool,tests,zoo,onnx,study]'
	@touch $@

train: install  ## train on Humanoid-v5; TIMESTEPS=, ENV=, SEED=, RESOLVER= can be given
	@$(BIN)/python examples/train.py --env '$(ENV)' --timesteps '$(TIMESTEPS)' --seed '$(SEED)' --resolver '$(RESOLVER)'

test: check pytest  ## all checks: format, lint, types, tests

check: install  ## format, lint, types
	@echo "== format"
	@$(BIN)/ruff format --check .
	@echo "== lint"
	@$(BIN)/ruff check .
	@echo "== types"
	@$(BIN)/mypy

pytest: install
	@echo "== tests"
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2

format: install  ## format and mend what can be mended
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

bench: install  ## measure the update against PPO and others (under 15 minutes)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[bench]'
	@$(BIN)/python -m benchmarks

build: install  ## make wheel and sdist in dist/, and try each in an environment of its own
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check build twine
	@rm -rf build dist
	@$(BIN)/python -m build
	@$(BIN)/python -m twine check --strict dist/*
	@$(BIN)/python tests/check_build.py

lower:  ## all tests with the oldest dependencies that setup.cfg allows
	@$(PYTHON) -m venv .venv-lower
	@$(PYTHON) tests/lower_bounds.py > .venv-lower/constraints.txt
	@.venv-lower/bin/python -m pip install --quiet --disable-pip-version-check -c .venv-lower/constraints.txt -e '.[plots,tests]'
	@OMP_NUM_THREADS=1 .venv-lower/bin/python -m pytest -n 2 -W ignore::DeprecationWarning  # old packages with new ones below them

test-mjlab:  ## ManagerVecEnv on mjlab, in an environment of its own, on the CPU (minutes)
	@$(PYTHON) -m venv .venv-mjlab
	@.venv-mjlab/bin/python -m pip install --quiet --disable-pip-version-check -c tests/mjlab/constraints.txt mjlab pytest -e .
	@OMP_NUM_THREADS=1 WARP_CACHE_PATH=$(CURDIR)/.venv-mjlab/kernels .venv-mjlab/bin/python -m pytest tests/mjlab

doc: install  ## the documentation in docs/_build/html; warnings are errors, and its Python blocks run
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	@echo "== site"
	@$(BIN)/sphinx-build -n -W --keep-going -q -b html docs docs/_build/html
	@echo "== blocks, links, keys"
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q tests/test_docs.py

clean:  ## remove the environment and all caches
	rm -rf $(VENV) .venv-lower .venv-mjlab build dist docs/_build *.egg-info .mypy_cache .pytest_cache .ruff_cache
