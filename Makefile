# SPDX-License-Identifier: Apache-2.0
# Everything is installed into .venv and .venv-core, in the versions of requirements/*.lock; nothing outside this folder.

PYTHON ?= python3
# Not in the locks, because pip's index decides whether it is a CPU or a CUDA build.
TORCH ?= torch==2.13.0

# A stamp's name carries the content that was installed: a changed lock is installed again, an unchanged one never.
# Every installation into an environment removes the stamps of the former ones; dev contains demo.
key = $(shell { echo "$(TORCH)"; cat requirements/$(1).lock setup.py; } | sha256sum | cut -c1-12)
DEMO := .venv/installed/demo-$(call key,demo)
DEV := .venv/installed/dev-$(call key,dev)
CORE := .venv-core/installed/core_test-$(call key,core_test)
MESSAGES := .venv/installed/messages-$(shell find tests/support/message_packages -type f -not -name '*.pyc' | LC_ALL=C sort | xargs cat | sha256sum | cut -c1-12)

# Two tests at a time. A file's tests mostly stay in one process, which has the results that they share.
BESIDE := -n 2 --dist worksteal

NODE_FAULTS := tests/with_ros/node/test_node_faults.py tests/with_ros/node/test_lifecycle.py \
  tests/with_ros/node/test_surround_depth_node.py::test_transforms_that_make_no_tree_are_refused_by_name_and_the_others_taken

against = $$(case $$name in (training_step|node) echo --against $(AGAINST);; esac)
BENCHMARKS := $(filter-out measuring table camera_loop,$(basename $(notdir $(wildcard benchmarks/*.py))))

# A sourced ROS 2 installation must not leak into the wheels' environment, and nothing here talks to other machines.
unexport PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH CMAKE_PREFIX_PATH LD_LIBRARY_PATH RMW_IMPLEMENTATION ROS_DISTRO
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: help demo bench ablation test lint test-ros test-core test-faults fuzz soak messages lock clean

help: ## list the targets
	@sed -n 's/^\([a-z0-9_-]*\):.* ## /\1\t/p' Makefile | expand -t 12

demo: $(DEMO) ## play the sample recording to the live node over DDS; pictures and a table in output/demo
	.venv/bin/python -m cvcdepth_ros.demo --output output/demo

# Of the training step and of the node, the trainer and node of other checkouts are measured too (AGAINST=../of_yesterday).
bench: $(DEV) ## run every benchmark, an hour on a quiet machine; its table into docs/performance.md (AGAINST=CHECKOUT)
	@mkdir -p output/bench
	@for name in $(BENCHMARKS); do \
		echo "$$name ..." && .venv/bin/python benchmarks/$$name.py $(if $(AGAINST),$(against)) \
		  > output/bench/$$name.jsonl || exit 1; done
	.venv/bin/python benchmarks/table.py $(BENCHMARKS:%=output/bench/%.jsonl)

ablation: $(DEV) ## the paper's ablation on simulated drives, for hours: into OUT=FOLDER, from FROM=CHECKPOINT; goes on where it was
	.venv/bin/python tools/ablation_worlds.py -o $(or $(OUT),output/ablation) $(if $(FROM),--from $(FROM))

# The soak mostly waits, and asserts nothing about time.
test: lint test-ros ## everything that CI runs: lint, all tests, and three minutes of soak beside the slow ones
	@mkdir -p output; .venv/bin/python tools/soak.py --minutes 3 --output output/soak_short.json \
	  >output/soak_short.log 2>&1 & soak=$$!; \
	$(MAKE) test-core; tests=$$?; wait $$soak; soaked=$$?; \
	echo "soak: $$(tail -n 1 output/soak_short.log)"; exit $$((tests | soaked))

lint: $(DEV) ## ruff and mypy
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

test-ros: $(DEV) messages ## the tests in tests/with_ros, with ROS 2 from wheels
	.venv/bin/python -m pytest $(BESIDE) tests/with_ros

test-core: $(CORE) ## all other tests, in an environment without ROS
	@if .venv-core/bin/python -c 'import rclpy' 2>/dev/null; then echo "rclpy is in .venv-core: make clean"; exit 1; fi
	.venv-core/bin/python -m pytest $(BESIDE) tests/core tests/faults
	.venv-core/bin/python -m pytest $(BESIDE) tests/ros_side tests/whole

test-faults: $(DEV) ## inject every fault into node and tool; the table of reactions in output/faults.md
	@mkdir -p output && rm -f output/faults.md
	.venv/bin/python -m pytest tests/faults $(NODE_FAULTS) --all-faults --fault-table output/faults.md

fuzz: $(DEV) ## fuzz everything that reads foreign bytes (SECONDS=60 for each target); findings in fuzz/findings
	.venv/bin/pip install -qq --only-binary :all: atheris==3.0.0
	for target in compressed_images raw_images messages recordings metadata rig_files; do \
	  .venv/bin/python fuzz/run.py $$target --seconds $(or $(SECONDS),60) --corpus fuzz/found/$$target || exit 1; done

soak: $(DEV) ## feed the node with faults for MINUTES=60 and watch memory, files and threads
	.venv/bin/python tools/soak.py --minutes $(or $(MINUTES),60) --output output/soak.json

messages: $(DEV) ## build message packages without wheels, for tests of /tf_static and video (needs g++)
	@test -e $(MESSAGES) || .venv/bin/python tests/support/message_packages/build.py $(MESSAGES)

lock: .venv-lock/bin/uv ## resolve requirements/*.in again (LOCK=--upgrade for newer versions)
	$(call compile,dev) $(LOCK)
	$(call compile,demo) --constraints requirements/dev.lock
	$(call compile,core_test) --constraints requirements/dev.lock

clean: ## remove all that was installed, built or written by make
	rm -rf .venv .venv-core .venv-lock build install log dist output/demo *.egg-info .mypy_cache .pytest_cache .ruff_cache

compile = .venv-lock/bin/uv pip compile --quiet --universal --generate-hashes --python-version 3.10 --no-annotate \
	--custom-compile-command "make lock" requirements/$(1).in --output-file requirements/$(1).lock

# Wheels only, so that no compiler is ever needed; empy, pure Python, is published as source alone. All that is in the
# lock must have the lock's hash. torch comes last: then nothing of what it needs is open any more, and its own hash
# cannot be known, for it is another file on each index. pip shows its progress for that, by far the largest download.
define install
@echo "Installing requirements/$(2).lock into $(1), once: about a minute, longer on a slow connection."
@rm -rf $(1)/installed
@$(1)/bin/pip install -qq --require-hashes --no-deps --only-binary :all: --no-binary empy --requirement requirements/$(2).lock
@$(1)/bin/pip install --only-binary :all: "$(TORCH)"
@$(1)/bin/pip install -qq --no-deps --no-build-isolation --editable .
@mkdir $(1)/installed && touch $@
endef

$(DEMO): .venv/bin/python
	$(call install,.venv,demo)

$(DEV): .venv/bin/python
	$(call install,.venv,dev)
	@touch $(DEMO)

$(CORE): .venv-core/bin/python
	$(call install,.venv-core,core_test)

%/bin/python:
	@$(PYTHON) tools/check_machine.py
	@$(PYTHON) -m venv --clear $*

.venv-lock/bin/uv: .venv-lock/bin/python
	@.venv-lock/bin/pip install -qq uv==0.13.9
