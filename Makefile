# `make demo` and `make test` are the two commands a newcomer needs; each sets everything up first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: setup test lint demo demo-skin bench fuzz crash fidelity mutation clean

setup: $(STAMP)

$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed; name one with make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint
	$(BIN)/python -m pytest -n 2

demo: setup
	$(BIN)/tactile demo --out demo.mcap --png demo.png

demo-skin: setup
	$(BIN)/tactile demo-skin --out demo-skin.mcap --png demo-skin.png

# The longer runs. Each leaves its result where docs/results keeps it.
bench: setup
	$(BIN)/tactile bench --json docs/results/bench.json

fuzz: setup
	$(BIN)/tactile fuzz --frames 10000000 --json docs/results/fuzz.json

crash: setup
	$(BIN)/tactile crash --kills 1000 --json docs/results/crash.json

fidelity: setup
	$(BIN)/tactile fidelity --json docs/results/fidelity.json

mutation: setup
	$(BIN)/tactile mutation --json docs/results/mutation.json

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache
