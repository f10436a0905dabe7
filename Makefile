VENV := .venv
BOOTSTRAP = '$(or $(PYTHON),$(wildcard $(VENV)/bin/python),python3)' bootstrap.py
IN_ROS = . $(VENV)/environment.sh;

.DEFAULT_GOAL := help
.PHONY: help setup setup-training demo firmware-demo radio-demo paper test test-fast colcon path-for-colcon docs docs-links lint lock clean

help:  ## show this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1\t\2/' | expand -t 24

setup:  ## install everything that running needs into .venv
	@$(BOOTSTRAP) run
setup-training:  ## the same, with torch and the test tools
	@$(BOOTSTRAP) develop

demo: setup  ## replay RECORDING=path (default: simulated) through driver and mitigator, live
	@$(IN_ROS) $(VENV)/bin/python -m uwb_mitigation.commands.entry demo $(if $(RECORDING),--recording '$(RECORDING)') $(if $(RATE),--rate $(RATE))

firmware-demo: setup  ## the firmware in an emulated Cortex-M4 as the driver's board (RECORDING=path), compared with the host
	@$(IN_ROS) $(VENV)/bin/python -m benchmarks firmware-demo $(if $(RECORDING),--recording '$(RECORDING)')

radio-demo: setup  ## a tag and four anchors on modelled DW1000s, in the simulated flat: raw, corrected and true ranges
	@$(IN_ROS) $(VENV)/bin/python -m benchmarks radio-demo

test-fast: setup-training  ## the tests that need neither ROS nor torch and are quick: a minute on two cores
	@$(VENV)/bin/python -m pytest -q -n auto --fast

# More at once than processors: nodes spend most of a test on waiting for each other.
test: setup-training  ## run every test (COVERAGE=yes: and show what they reach)
	@$(IN_ROS) $(VENV)/bin/python -m pytest -n $$(($$(nproc) + 3)) --dist worksteal $(if $(COVERAGE),--cov --cov-report=term:skip-covered)

# What a machine with ROS 2 does by hand; without one, the environment stands in for /opt/ros/jazzy.
COLCON = $(IN_ROS) PATH="$(CURDIR)/$(VENV)/bin:$$PATH" AMENT_PREFIX_PATH="$${AMENT_PREFIX_PATH:-$(CURDIR)/$(VENV)}" \
  CMAKE_TOOLCHAIN_FILE="$(CURDIR)/cmake/ros_wheels.cmake" colcon
COLCON_TESTS = $(addprefix test/test_,installed.py preprocessing.py mitigation.py bag_codec.py link_messages.py launch.py)

colcon: path-for-colcon setup-training  ## colcon build and colcon test (what was installed, and the quick tests)
	@$(COLCON) build --base-paths . msg_defs
	@$(COLCON) test --base-paths . msg_defs --event-handlers console_cohesion+ --return-code-on-test-failure \
	  --packages-select uwb_mitigation --pytest-args $(COLCON_TESTS)
	@$(COLCON) test-result --verbose
	@grep -q 'skipped="0" tests="[1-9]' build/uwb_mitigation/pytest.xml  # a skipped test, or none at all, is a failure too

path-for-colcon:
	@! pwd | LC_ALL=C grep -q '[^][:alnum:] /._+@,:=-]' || \
	  { echo "colcon: CMake's macros of ROS do not accept the path $(CURDIR): move the checkout to one of ASCII letters, digits and spaces" >&2; exit 1; }

# The paper's experiment. Networks that an interrupted run has trained are kept. Other data, and quick runs, have folders of their own.
PAPER_QUICK = --windows 157,16 --seeds 1
PAPER = build/paper/$(if $(DATA),$(shell echo '$(DATA)' | tr '/ ' '__'),simulated)$(if $(QUICK),-quick)
PAPER_DATA = $(or $(DATA),build/paper/deepuwb.mcap)

paper: setup-training  ## the paper's experiment, the firmware's cost and their report: 50 minutes (QUICK=1: 5; DATA=deepuwb.pkl)
	@test -z '$(DATA)' || test -e '$(DATA)' || { echo "DATA=$(DATA) is not there" >&2; exit 1; }
	@mkdir -p $(PAPER); test -e '$(PAPER_DATA)' || $(VENV)/bin/uwb-mitigation paper simulate -o $(PAPER_DATA)
	@$(VENV)/bin/python -m benchmarks firmware $(if $(QUICK),--inputs 200 --no-portable) --json $(PAPER)/firmware.json
	@$(VENV)/bin/uwb-mitigation paper protocol --data '$(PAPER_DATA)' -o $(PAPER)/models $(if $(QUICK),$(PAPER_QUICK))
	@$(VENV)/bin/uwb-mitigation paper report --data '$(PAPER_DATA)' -o $(PAPER) --models $(PAPER)/models --firmware $(PAPER)/firmware.json
	@echo "$(CURDIR)/$(PAPER)/report.html"

SPHINX = $(VENV)/bin/sphinx-build --fail-on-warning --keep-going --nitpicky --fresh-env --quiet --jobs auto -c docs -d build/doctrees .

docs:  ## build the documentation into build/site; a warning or a link within that leads nowhere is an error
	@$(BOOTSTRAP) docs
	@$(SPHINX) build/site
	@echo build/site/docs/index.html

docs-links:  ## look whether the documentation's links to elsewhere are alive (needs a network)
	@$(BOOTSTRAP) docs
	@$(SPHINX) -b linkcheck build/links

lint: setup-training  ## ruff, mypy and the language check
	@$(VENV)/bin/ruff check . && $(VENV)/bin/ruff format --check . && $(VENV)/bin/mypy
	@$(VENV)/bin/python docs/style/check_words.py

lock:  ## write requirements/*.txt anew from requirements/*.in, and jazzy/*.txt beside what ROS brings (needs uv)
	cd requirements && for part in runtime ros develop training docs; do \
	  uv pip compile --quiet --universal --python-version 3.10 --no-header --no-annotate \
	    $$(for done in runtime ros develop training; do [ $$done = $$part ] && break; echo -c $$done.txt; done) \
	    $$part.in -o $$part.txt || exit 1; done
	cd requirements && for part in runtime develop training docs; do \
	  uv pip compile --quiet --universal --python-version 3.12 --no-header --no-annotate -c ros_constraints.txt \
	    $$(for done in runtime develop training; do [ $$done = $$part ] && break; echo -c jazzy/$$done.txt; done) \
	    $$part.in $$([ $$part = runtime ] && echo jazzy.in) -o jazzy/$$part.txt || exit 1; done

clean:  ## remove .venv and everything built
	rm -rf $(VENV) build install log .pytest_cache .mypy_cache .ruff_cache
