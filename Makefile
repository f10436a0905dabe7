VENV := .venv
SETUP = PYTHON='$(PYTHON)' ./setup.sh
IN_ROS = . $(VENV)/environment.sh;
# With compiled files, processes start in half the time.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help setup setup-training demo firmware-demo radio-demo paper test test-fast colcon path-for-colcon figures docs docs-links lint lock clean

help:  ## show this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1\t\2/' | expand -t 24

setup:  ## install what nodes and commands need into .venv
	@$(SETUP) run
setup-training:  ## the same, with torch and the test tools
	@$(SETUP) develop

demo: setup  ## replay RECORDING=path (default: simulated) through driver and mitigator, live
	@$(IN_ROS) $(VENV)/bin/python -m benchmarks demo $(if $(RECORDING),--recording '$(RECORDING)') $(if $(RATE),--rate $(RATE))

firmware-demo: setup  ## the firmware in an emulated Cortex-M4 as the driver's board (RECORDING=path), compared with the host
	@$(IN_ROS) $(VENV)/bin/python -m benchmarks firmware-demo $(if $(RECORDING),--recording '$(RECORDING)')

radio-demo: setup  ## a tag and four anchors on modelled DW1000s, in the simulated flat: raw, corrected and true ranges
	@$(IN_ROS) $(VENV)/bin/python -m benchmarks radio-demo

test-fast: setup-training  ## the quick tests without ROS and torch: a minute on two cores
	@$(VENV)/bin/python -m pytest -q -n auto --fast

# More workers than processors: during most of a test, nodes wait for each other. The tests of a file share its fixtures.
# A failed test is repeated, at most three in a run, and listed as RERUN: it has a race, which is a defect.
test: setup-training  ## run all tests (COVERAGE=yes: with the coverage of the code)
	@$(IN_ROS) $(VENV)/bin/python -m pytest -n $$(($$(nproc) + 3)) --dist loadfile --no-loadscope-reorder -raR --reruns 1 --max-suite-reruns 3 --rerun-show-tracebacks \
	  $(if $(COVERAGE),--cov --cov-report=term:skip-covered)

# The commands of a user with ROS 2; without ROS, .venv is used in place of /opt/ros/jazzy.
COLCON = $(IN_ROS) PATH="$(CURDIR)/$(VENV)/bin:$$PATH" AMENT_PREFIX_PATH="$${AMENT_PREFIX_PATH:-$(CURDIR)/$(VENV)}" \
  CMAKE_TOOLCHAIN_FILE="$(CURDIR)/cmake/ros_wheels.cmake" colcon
COLCON_TESTS = test/test_installed.py test/test_launch.py

colcon: path-for-colcon setup-training  ## colcon build and colcon test (of the installed files)
	@$(COLCON) build --base-paths . msg_defs
	@$(COLCON) test --base-paths . msg_defs --event-handlers console_cohesion+ --return-code-on-test-failure \
	  --packages-select uwb_mitigation --pytest-args $(COLCON_TESTS)
	@$(COLCON) test-result --verbose
	@grep -q 'skipped="0" tests="[1-9]' build/uwb_mitigation/pytest.xml  # fails if a test was skipped, or if no test ran

path-for-colcon:
	@! pwd | LC_ALL=C grep -q '[^][:alnum:] /._+@,:=-]' || \
	  { echo "colcon: CMake's macros of ROS do not accept the path $(CURDIR): move the checkout to one of ASCII letters, digits and spaces" >&2; exit 1; }

# Networks that an interrupted run has trained are used again. Other data and quick runs have separate folders.
PAPER_QUICK = --windows 157,16 --seeds 1 --epochs 5 --trials 2
PAPER = build/paper/$(if $(DATA),$(shell echo '$(DATA)' | tr '/ ' '__'),simulated)$(if $(QUICK),-quick)
PAPER_DATA = $(or $(DATA),build/paper/deepuwb.mcap)

paper: setup-training  ## the paper's experiment, the firmware's cost and their report: 50 minutes (QUICK=1: 4; DATA=deepuwb.pkl)
	@test -z '$(DATA)' || test -e '$(DATA)' || { echo "DATA=$(DATA) does not exist" >&2; exit 1; }
	@mkdir -p $(PAPER); test -e '$(PAPER_DATA)' || $(VENV)/bin/python -m benchmarks paper simulate -o $(PAPER_DATA)
	@$(VENV)/bin/python -m benchmarks firmware $(if $(QUICK),--inputs 200 --no-portable) --json $(PAPER)/firmware.json
	@$(VENV)/bin/python -m benchmarks paper protocol --data '$(PAPER_DATA)' -o $(PAPER)/models $(if $(QUICK),$(PAPER_QUICK))
	@$(VENV)/bin/python -m benchmarks paper report --data '$(PAPER_DATA)' -o $(PAPER) --models $(PAPER)/models --firmware $(PAPER)/firmware.json
	@echo "$(CURDIR)/$(PAPER)/report.html"

figures: setup-training  ## measure the figures of the pages again (about two hours), and print what differs (WORDS='results nodes')
	@$(IN_ROS) $(VENV)/bin/python docs/figures.py $(WORDS)

SPHINX = $(VENV)/bin/sphinx-build --fail-on-warning --keep-going --nitpicky --fresh-env --quiet --jobs auto -c docs -d build/doctrees .

docs:  ## build the documentation into build/site; warnings and broken internal links are errors
	@$(SETUP) docs
	@$(SPHINX) build/site
	@echo build/site/docs/index.html

docs-links:  ## check the external links of the documentation (needs a network)
	@$(SETUP) docs
	@$(SPHINX) -b linkcheck build/links

lint: setup-training  ## ruff, mypy and the language check
	@$(VENV)/bin/ruff check . && $(VENV)/bin/ruff format --check . && $(VENV)/bin/mypy
	@$(VENV)/bin/python docs/style/check_words.py

LOCK = $(VENV)/bin/uv pip compile --quiet --universal --no-header --no-annotate
lock: setup  ## resolve requirements/*.in again: for ROS wheels, and for a system with ROS 2 Jazzy
	cd requirements && ../$(LOCK) --python-version 3.10 runtime.in ros.in develop.in training.in docs.in -o lock.txt
	cd requirements && ../$(LOCK) --python-version 3.12 -c ros_constraints.txt runtime.in jazzy.in develop.in training.in docs.in -o lock_jazzy.txt

clean:  ## remove .venv and all generated files
	rm -rf $(VENV) build install log .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis .coverage* docs/reference
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
