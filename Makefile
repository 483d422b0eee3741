# `make demo` and `make test` are the two commands a newcomer needs; each sets everything up first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
SOAK_MINUTES ?= 60
KILLS ?= 1000

.PHONY: setup test test-random lint docs-reference demo demo-skin bench fuzz crash fidelity mutation gate-random gate-coverage stress soak fuzz-pipeline kills docs pictures clean

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

# The property tests on new examples; `make test` draws the same ones every time. RUNS=20: as often.
RUNS ?= 1
test-random: setup
	@for run in $$(seq $(RUNS)); do \
	  $(BIN)/python -m pytest -q -n 2 --hypothesis-profile=random -m "hypothesis or random" || exit 1; done

# The reference of every configuration file, from the code that reads them.
docs-reference: setup
	$(BIN)/python -m tactile_tools.dev.config_reference docs/configuration.md

demo: setup
	$(BIN)/tactile demo --out demo.mcap --png demo.png

demo-skin: setup
	$(BIN)/tactile demo-skin --out demo-skin.mcap --png demo-skin.png

# The longer runs. Each leaves its result where docs/results keeps it.
bench: setup
	$(BIN)/tactile bench --out docs/results/bench.json

fuzz: setup
	$(BIN)/tactile fuzz --frames 10000000 --out docs/results/fuzz.json

crash: setup
	$(BIN)/tactile crash --kills 1000 --out docs/results/crash.json

fidelity: setup
	$(BIN)/tactile fidelity --out docs/results/fidelity.json

mutation: setup
	$(BIN)/tactile mutation --out docs/results/mutation.json

# A million random inputs through the safety gate.
gate-random: setup
	REACH_RANDOM_INPUTS=1000000 REACH_RANDOM_JSON=docs/results/gate.json $(BIN)/python -m pytest -q tests/reach/test_gate_random.py

# Every branch of the safety gate is taken by its tests, or this fails.
gate-coverage: setup
	REACH_RANDOM_INPUTS=4000 $(BIN)/python -m coverage run --branch --source=host/reachd -m pytest -q tests/reach -k gate
	$(BIN)/python -m coverage report -m --fail-under=100 --include='*/gate/*.py'

# An hour of reaching while the machine is loaded and its memory churned.
stress: setup
	$(BIN)/tactile bench --only stress --out docs/results/stress.json

# An hour of four boards, one of them pulled out and plugged in each second.
soak: setup
	$(BIN)/tactile soak --minutes $(SOAK_MINUTES) --out docs/results/soak.json

# A million frames with right CRCs that say anything, through links and pipeline.
fuzz-pipeline: setup
	$(BIN)/tactile fuzz --through pipeline --frames 1000000 --out docs/results/fuzz-pipeline.json

# A thousand kills of simulator, tactiled and reachd while they reach; two to three hours.
kills: setup
	$(BIN)/tactile crash --processes --kills $(KILLS) --out docs/results/kills.json

# The documents as a site in build/site, offline.
docs: setup
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	$(BIN)/mkdocs build --strict

# Pages and pictures that are made from the code.
pictures: setup
	$(BIN)/python -m tactile_tools.dev.architecture docs/pictures
	$(BIN)/python -m tactile_tools.dev.topics_page docs/topics.md

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache
