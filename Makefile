# make demo    all the set-up, then a driver and a mitigator over real ROS 2, live
# make test    all the set-up, then every test
# make setup   the set-up alone; make help lists the rest

# Of the environment, when it is made; without it, the one that it was made with, or python3.
PYTHON ?=
RECORDING ?=
RATE ?=
VENV := .venv
BOOTSTRAP = $(if $(PYTHON),'$(PYTHON)' bootstrap.py,python3 bootstrap.py --keep-python)
# Empty unless ROS is the system's: bootstrap.py writes it.
IN_ROS = . $(VENV)/environment.sh;

.DEFAULT_GOAL := help
.PHONY: help setup setup-training setup-docs demo firmware-demo radio-demo paper test colcon docs docs-links lint lock clean

help:  ## show this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1\t\2/' | expand -t 24

setup:  ## install everything that running needs into .venv
	@$(BOOTSTRAP) run

setup-training:  ## the same, with torch and the test tools
	@$(BOOTSTRAP) develop

demo: setup  ## replay RECORDING=path (default: simulated) through driver and mitigator, live
	@$(IN_ROS) $(VENV)/bin/python -m uwb_mitigation.entry demo $(if $(RECORDING),--recording '$(RECORDING)') $(if $(RATE),--rate $(RATE))

firmware-demo: setup  ## the firmware in an emulated Cortex-M4 as the driver's board (RECORDING=path), compared with the host
	@$(IN_ROS) $(VENV)/bin/python -m uwb_mitigation.entry firmware-demo $(if $(RECORDING),--recording '$(RECORDING)')

radio-demo: setup  ## a tag and four anchors on modelled DW1000s, in the simulated flat: raw, corrected and true ranges
	@$(IN_ROS) $(VENV)/bin/python -m benchmarks radio-demo

# Which lines the tests reach costs half as much time again: shown where it is asked for, as the hosted CI does once.
COVERAGE ?=

# More at once than processors: nodes spend most of a test on waiting for each other.
test: setup-training  ## run every test (COVERAGE=yes: and show what they reach)
	@$(IN_ROS) $(VENV)/bin/python -m pytest -n $$(($$(nproc) + 2)) $(if $(COVERAGE),--cov --cov-report=term:skip-covered)

# ROS's CMake macros take neither an apostrophe nor a letter beyond ASCII in a path: below such a one, the packages
# are found by a link, and built and installed beside it.
ELSEWHERE := $(shell pwd | LC_ALL=C tr -d '[:alnum:] /._+@,:=-' | grep -q . && echo "$${TMPDIR:-/tmp}/uwb_mitigation_$$(pwd | cksum | cut -d ' ' -f 1)")
WORKSPACE = $(or $(ELSEWHERE),$(CURDIR))
CHECKOUT = $(if $(ELSEWHERE),$(ELSEWHERE)/checkout,$(CURDIR))
PLACES = --base-paths "$(CHECKOUT)" "$(CHECKOUT)/msg_defs" --build-base "$(WORKSPACE)/build" --install-base "$(WORKSPACE)/install"

# What a machine with ROS 2 does by hand; without one, the environment stands in for /opt/ros/jazzy.
COLCON = $(IN_ROS) PATH="$(CHECKOUT)/$(VENV)/bin:$$PATH" \
  AMENT_PREFIX_PATH="$${AMENT_PREFIX_PATH:-$(CHECKOUT)/$(VENV)}" CMAKE_TOOLCHAIN_FILE="$(CHECKOUT)/cmake/ros_wheels.cmake" colcon

# What was installed, and tests that take a second or two; `make test` runs all of them.
COLCON_TESTS = test/test_installed.py test/test_measurement.py test/test_preprocessing.py test/test_mitigation.py \
  test/test_bag_codec.py test/test_link_messages.py test/test_tally.py test/test_launch.py

colcon: setup-training  ## colcon build and colcon test (what was installed, and the quick tests)
	@$(if $(ELSEWHERE),mkdir -p "$(ELSEWHERE)" && ln -sfn "$(CURDIR)" "$(CHECKOUT)")
	@$(COLCON) build $(PLACES)
	@$(COLCON) test $(PLACES) \
	  --event-handlers console_cohesion+ --return-code-on-test-failure \
	  --packages-select uwb_mitigation --pytest-args $(COLCON_TESTS)
	@$(COLCON) test-result --test-result-base "$(WORKSPACE)/build" --verbose
	@grep -q 'skipped="0" tests="[1-9]' "$(WORKSPACE)/build/uwb_mitigation/pytest.xml"  # a test that was skipped, or none at all, is a failure too

# The paper's experiment. A step whose output is newer than its inputs is skipped, and of one that was interrupted,
# networks that are trained already. Other data, and quick runs, have folders of their own.
DATA ?=
QUICK ?=
PAPER_QUICK = --windows 157,16 --seeds 1
space := $(subst ,, )
PAPER = build/paper/$(if $(DATA),$(subst /,_,$(subst $(space),_,$(DATA))),simulated)$(if $(QUICK),-quick)
PAPER_DATA = $(if $(DATA),$(DATA),build/paper/deepuwb.mcap)

paper: setup-training  ## the paper's experiment, the firmware's bench and their report: 50 minutes (QUICK=1: 5; DATA=deepuwb.pkl)
	@test -z '$(DATA)' || test -e '$(DATA)' || { echo "DATA=$(DATA) is not there" >&2; exit 1; }
	@$(MAKE) --no-print-directory $(PAPER)/report.html
	@echo "$(CURDIR)/$(PAPER)/report.html"

build/paper/deepuwb.mcap:
	@echo "1 of 4: simulated rooms in DeepUWB's shape"; mkdir -p $(@D)
	@$(VENV)/bin/uwb-mitigation paper simulate --force -o $@

$(PAPER)/firmware.json: $(wildcard firmware/src/*.[ch] firmware/src/cortex_m4/* uwb_mitigation/firmware_export/*.py)
	@echo "2 of 4: the firmware in an emulator"; mkdir -p $(@D)
	@$(VENV)/bin/python -m benchmarks firmware $(if $(QUICK),--inputs 200 --no-portable) --json $@

# After the bench, which says at once if its tools are not there.
$(PAPER)/models/protocol.json: $(subst $(space),\ ,$(PAPER_DATA)) | $(PAPER)/firmware.json
	@echo "3 of 4: the networks, about $(if $(QUICK),4,48) minutes on two cores"
	@$(VENV)/bin/uwb-mitigation paper protocol --data '$(PAPER_DATA)' -o $(@D) $(if $(QUICK),$(PAPER_QUICK))

$(PAPER)/report.html: $(PAPER)/models/protocol.json $(PAPER)/firmware.json $(wildcard uwb_mitigation/paper/* uwb_mitigation/paper/templates/*)
	@echo "4 of 4: the page"
	@$(VENV)/bin/uwb-mitigation paper report --data '$(PAPER_DATA)' -o $(@D) \
	  --models $(PAPER)/models --firmware $(PAPER)/firmware.json

setup-docs:
	@$(BOOTSTRAP) docs

SPHINX = $(VENV)/bin/sphinx-build --fail-on-warning --keep-going --nitpicky --fresh-env --quiet --jobs auto -c docs -d build/doctrees .

docs: setup-docs  ## build the documentation into build/site; a warning or a link within that leads nowhere is an error
	@$(SPHINX) build/site
	@echo build/site/docs/index.html

docs-links: setup-docs  ## look whether the documentation's links to elsewhere are alive (needs a network)
	@$(SPHINX) -b linkcheck build/links

lint: setup-training  ## ruff and mypy
	@$(VENV)/bin/ruff check .
	@$(VENV)/bin/ruff format --check .
	@$(VENV)/bin/mypy

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
