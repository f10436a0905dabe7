# make demo    all the set-up, then a driver and a mitigator over real ROS 2, live
# make test    all the set-up, then every test
# make setup   the set-up alone; make help lists the rest

PYTHON ?= python3
RECORDING ?=
RATE ?=
VENV := .venv
# Empty unless ROS is the system's: bootstrap.py writes it.
IN_ROS = . $(VENV)/environment.sh;

.DEFAULT_GOAL := help
.PHONY: help setup setup-training setup-docs demo firmware-demo test colcon docs docs-links lint lock clean

help:  ## show this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1\t\2/' | expand -t 24

setup:  ## install everything that running needs into .venv
	@$(PYTHON) bootstrap.py run

setup-training:  ## the same, with torch and the test tools
	@$(PYTHON) bootstrap.py develop

demo: setup  ## replay RECORDING=path (default: simulated) through driver and mitigator, live
	@$(IN_ROS) $(VENV)/bin/python -m uwb_mitigation.nodes.demo $(if $(RECORDING),--recording '$(RECORDING)') $(if $(RATE),--rate $(RATE))

firmware-demo: setup  ## the firmware in an emulated Cortex-M4 as the driver's board (RECORDING=path), compared with the host
	@$(IN_ROS) $(VENV)/bin/python -m uwb_mitigation.nodes.firmware_demo $(if $(RECORDING),--recording '$(RECORDING)')

test: setup-training  ## run every test
	@$(IN_ROS) $(VENV)/bin/python -m pytest -n auto

# What a machine with ROS 2 does by hand; without one, the environment stands in for /opt/ros/jazzy.
COLCON = $(IN_ROS) PATH="$(CURDIR)/$(VENV)/bin:$$PATH" \
  AMENT_PREFIX_PATH="$${AMENT_PREFIX_PATH:-$(CURDIR)/$(VENV)}" CMAKE_TOOLCHAIN_FILE="$(CURDIR)/cmake/ros_wheels.cmake" colcon

# What was installed, and tests that take a second or two; `make test` runs all of them.
COLCON_TESTS = test/test_installed.py test/test_measurement.py test/test_preprocessing.py test/test_mitigation.py \
  test/test_bag_codec.py test/test_link_messages.py test/test_tally.py test/test_launch.py

colcon: setup-training  ## colcon build and colcon test (what was installed, and the quick tests)
	@$(COLCON) build
	@$(COLCON) test --event-handlers console_cohesion+ --return-code-on-test-failure \
	  --packages-select uwb_mitigation --pytest-args $(COLCON_TESTS)
	@$(COLCON) test-result --verbose
	@grep -q 'skipped="0" tests="[1-9]' build/uwb_mitigation/pytest.xml  # a test that was skipped, or none at all, is a failure too

setup-docs:
	@$(PYTHON) bootstrap.py docs

SPHINX = $(VENV)/bin/sphinx-build --fail-on-warning --keep-going --nitpicky --fresh-env --quiet -c docs -d build/doctrees .

docs: setup-docs  ## build the documentation into build/site; a warning or a link within that leads nowhere is an error
	@$(SPHINX) build/site
	@echo build/site/docs/index.html

docs-links: setup-docs  ## look whether the documentation's links to elsewhere are alive (needs a network)
	@$(SPHINX) -b linkcheck build/links

lint: setup-training  ## ruff and mypy
	@$(VENV)/bin/ruff check .
	@$(VENV)/bin/ruff format --check .
	@$(VENV)/bin/mypy

lock:  ## write requirements/*.txt anew from requirements/*.in (needs uv)
	cd requirements && for part in runtime ros develop training docs; do \
	  uv pip compile --quiet --universal --python-version 3.10 --no-header --no-annotate \
	    $$(for done in runtime ros develop training; do [ $$done = $$part ] && break; echo -c $$done.txt; done) \
	    $$part.in -o $$part.txt || exit 1; done

clean:  ## remove .venv and everything built
	rm -rf $(VENV) build install log .pytest_cache .mypy_cache .ruff_cache
