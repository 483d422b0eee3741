# `make demo` and `make test` are the two commands a newcomer needs; each sets everything up first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
SOAK_MINUTES ?= 60
KILLS ?= 1000
RIGS ?= 1

.DEFAULT_GOAL := help
.PHONY: help setup test test-random test-loaded lint demo demo-ur arms arms-scenes demo-skin bench fuzz crash fidelity mutation gate-random gate-coverage hostile recordings stress soak fuzz-pipeline kills firmware-test docs docs-reference leaderboard pictures clean

help:  ## list the targets (what `make` alone does)
	@echo "make TARGET, where TARGET is one of:"
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  \1\t\2/' | expand -t 18

setup: $(STAMP)  ## make .venv with everything the tests need: minutes, several hundred MB

$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed; name one with make PYTHON=python3.12")'
	@echo "Setting up $(VENV): takes some minutes and fetches several hundred MB the first time."
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --disable-pip-version-check --editable '.[dev]'
	@touch $@

lint: setup  ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy examples/*.py

# Neighbouring tests share daemons and logs, so each worker gets a stretch of them.
WORKERS := -n 2 --dist worksteal
test: lint  ## set everything up, pass lint and all tests
	$(BIN)/python -m pytest $(WORKERS)

# The property tests on new examples; `make test` draws the same ones every time. RUNS=20: as often.
RUNS ?= 1
test-random: setup  ## the property tests on new examples; RUNS=20: as often
	@for run in $$(seq $(RUNS)); do \
	  $(BIN)/python -m pytest -q $(WORKERS) --hypothesis-profile=random -m "hypothesis or random" || exit 1; done

# The suite RUNS times beside two busy loops; docs/results/suite.json keeps a row for each run, so
# that it may be stopped and gone on with later. SINCE=COMMIT counts runs of later commits, too.
test-loaded: setup  ## the suite RUNS times beside two busy loops
	$(BIN)/python tests/loaded_runs.py --runs $(RUNS) $(if $(SINCE),--since $(SINCE))

# The reference of every configuration file, from the code that reads them.
docs-reference: setup  ## the reference of configuration files, from the code
	$(BIN)/python -m tactile_tools.dev.config_reference docs/configuration.md

# The page of strategies, from the entries that `tactile benchmark` wrote.
leaderboard: setup  ## docs/leaderboard.md from the entries in docs/results/benchmark
	$(BIN)/python -m tactile_tools.dev.leaderboard docs/results/benchmark docs/leaderboard.md

demo: setup  ## reach into a simulated cupboard, leave a log and a picture
	$(BIN)/tactile demo

# Such a reach with an emulated robot of Universal Robots, through armd and its vendor's client.
demo-ur: setup  ## the same with an emulated robot of Universal Robots
	$(BIN)/tactile demo --arm ur --seed 36

# The same fifty scenes with the simulated arm and with the emulated robot; half an hour, resumable.
arms-scenes: setup  ## 50 scenes with the simulated arm and an emulated UR; half an hour, goes on where cut off
	$(BIN)/tactile arm-scenes --scenes 50 --out docs/results/ur.json

# Every driver against every fault, ARMS_RUNS times over; some minutes a run. FRANKY_SIM=PATH: Franka, too.
ARMS_RUNS ?= 3
arms: setup  ## every driver of a robot against every fault, measured into docs/results/arms.json
	rm -f docs/results/arms.json
	ARMS_RUNS=$(ARMS_RUNS) ARMS_JSON=docs/results/arms.json $(BIN)/python -m pytest -q tests/armd --deselect tests/armd/test_report.py
	$(BIN)/python -m tests.support.arms_report

demo-skin: setup  ## press simulated boards, leave a log and a picture
	$(BIN)/tactile demo-skin

# The longer runs. Each leaves its result where docs/results keeps it.
bench: setup  ## measure every promised figure
	$(BIN)/tactile bench --out docs/results/bench.json

fuzz: setup  ## ten million corrupted frames
	$(BIN)/tactile fuzz --frames 10000000 --out docs/results/fuzz.json

crash: setup  ## a thousand kills of processes that log
	$(BIN)/tactile crash --kills 1000 --out docs/results/crash.json

fidelity: setup  ## compare with the authors' recorded outcomes
	$(BIN)/tactile fidelity --out docs/results/fidelity.json

mutation: setup  ## mutate the safety gate
	$(BIN)/tactile mutation --out docs/results/mutation.json

# A million random inputs through the safety gate.
gate-random: setup  ## a million random inputs through the safety gate
	REACH_RANDOM_INPUTS=1000000 REACH_RANDOM_JSON=docs/results/gate.json $(BIN)/python -m pytest -q tests/reachd/gate/test_gate_random.py

# A hundred thousand hostile items through the recorder and through tactiled's pipeline.
hostile: setup  ## 100,000 hostile items through recorder and pipeline
	HOSTILE_ITEMS=100000 $(BIN)/python -m pytest -q tests/tactile_core/log/test_recorder_hostile.py tests/tactiled/test_hostile.py -k hostile_items

# Every frame of every recording, none of which may be masked; of whole ones where ../shared has them.
recordings: setup  ## every frame of every recording of a real board
	RECORDED_FRAMES=1000000000 $(BIN)/python -m pytest -q tests/tactiled/sensing/test_played_readings.py -k never_masked

# Every branch of the safety gate is taken by its tests, or this fails.
gate-coverage: setup  ## every branch of the safety gate is taken by its tests
	REACH_RANDOM_INPUTS=4000 $(BIN)/python -m coverage run --branch --source=host/reachd -m pytest -q tests/reachd/gate tests/reachd/test_supervisor.py tests/reachd/test_settings.py tests/reachd/strategies/test_parameters.py
	$(BIN)/python -m coverage report -m --fail-under=100 --include='*/gate/*.py'

# An hour of reaching while the machine is loaded and its memory churned.
stress: setup  ## an hour of reaching while the machine is loaded
	$(BIN)/tactile bench --only stress --out docs/results/stress.json

# An hour of four boards, one of them pulled out and plugged in each second.
soak: setup  ## an hour of four boards, one replugged each second
	$(BIN)/tactile soak --minutes $(SOAK_MINUTES) --out docs/results/soak.json

# A million frames with right CRCs that say anything, through links and pipeline.
fuzz-pipeline: setup  ## a million hostile frames through the pipeline
	$(BIN)/tactile fuzz --through pipeline --frames 1000000 --out docs/results/fuzz-pipeline.json

# A thousand kills of simulator, tactiled and reachd while they reach; two hours, with RIGS=2 one. Goes
# on where it was cut off.
kills: setup  ## a thousand kills while they reach; two to three hours
	$(BIN)/tactile crash --processes --rigs $(RIGS) --kills $(KILLS) --out docs/results/kills.json

# The documents as a site in build/site, offline.
docs: setup  ## the documents as a site in build/site
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	$(BIN)/mkdocs build --strict

# Pages and pictures that are made from the code.
pictures: setup  ## pages and pictures that are made from the code
	$(BIN)/python -m tactile_tools.dev.architecture docs/pictures
	$(BIN)/python -m tactile_tools.dev.topics_page docs/topics.md

# The C headers: compilers, sanitizers, a million inputs of the fuzzer, emulators. Nothing is installed;
# what is not here is skipped, saying what to install (docs/firmware.md).
firmware-test: setup  ## the C headers: compilers, sanitizers, fuzzer, emulators
	TACTILE_FIRMWARE=full TACTILE_FIRMWARE_JSON=docs/results/firmware.json $(BIN)/python -m pytest -q -rs -n 0 --timeout 900 tests/sensor_proto/c

clean:  ## delete .venv and what tools leave
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache
