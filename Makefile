# make demo        from a fresh clone to a person in 3D on a page
# make demo-live   from videos to 3D, with MediaPipe Pose as the detector
# make test        environment, lint, types and all tests, several files at a time; TEST_PROCESSES=1: one after the other
# make lint        lint and types only
# make docs        the documentation site in build/site, warnings are errors
# make reference   docs/reference/ from the code
# make sanitize    the kernel's tests with a kernel that checks every access (ASan, UBSan)
# make fuzz        100000 spoilt inputs of every kind; takes hours
# make benchmark DATA=DIR  the paper's tables; DIR holds cmu/ and nrsfm/; interrupted, it goes on
# make benchmark-speed     speed against floors and other ways, side by side; DATA=DIR adds time_to_error
# make audit       known vulnerabilities of the pins in requirements.lock
# make lock        resolve requirements.lock anew, and requirements.hashes.lock: what a robot needs, with hashes
# make clean       remove what building and testing left; .venv, downloads, models and recordings stay
# make clean-demo  remove what the demos left in demo_output, with the model that they trained
#
# The environment .venv is made on first use: make PYTHON3=python3.12 chooses its Python.

PYTHON3 ?= python3
# Pins that exist for the oldest Python exist for the newer ones too.
LOCK_PYTHON ?= python3.11
LOCK_TORCH ?= torch==2.13.0

# The order matters: later programs reuse the trainings of earlier ones. Index: benchmarks/README.md.
BENCHMARKS := paper.table1_cmu paper.mirrored_frames paper.ablation paper.table3_unseen \
    robustness.noise robustness.missing_keypoints paper.table2_categories paper.classic_sequences \
    paper.coherence paper.protocols robustness.perspective robustness.confidence_calibration \
    robustness.smoothing robustness.corrupted_data
# The quick ones come first. Run them on an idle machine.
SPEED := speed.latency_breakdown speed.forward_pass speed.bag_reading speed.latency \
    speed.latency_while_training speed.training_speed speed.training_scale

SANITIZE_CC := gcc
LIBASAN = $(shell $(SANITIZE_CC) -print-file-name=libasan.so)
# Preloaded as well, since ASan looks for its exceptions when the process starts.
LIBSTDCXX = $(shell $(SANITIZE_CC) -print-file-name=libstdc++.so.6)
SANITIZERS := -fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer -g
SANITIZE_TESTS := test/kernel test/fuzz/test_kernel.py test/lifting/test_compiled_backend.py \
    test/lifting/test_tracking.py test/lifting/test_steady_depth.py test/body/test_kinematic_tree.py test/messages/test_serialised.py $(wildcard test/training/test_compiled_*.py)
SANITIZE_FUZZ ?= 1000

# Test files that run at the same time, each on a DDS domain of its own. One more than there are cores, as
# many tests wait for other processes.
TEST_PROCESSES ?= $(shell echo $$(($$(nproc 2>/dev/null || echo 1) + 1)))

PYTHON := .venv/bin/python
READY := .venv/.ready
# The demo alone needs neither linters nor what tests and benchmarks need.
DEMO_READY := .venv/.ready-demo
# Only what runs a detector needs it, and not every Python has it, so the lock leaves it out.
EXAMPLES_READY := .venv/.ready-examples

.PHONY: python-version docs demo demo-live test lint sanitize fuzz benchmark benchmark-speed audit lock clean clean-demo reference

demo: $(if $(wildcard $(READY)),$(READY),$(DEMO_READY))
	$(PYTHON) -m deep_nrsfm_ros.commands.demo --node

demo-live: $(EXAMPLES_READY)
	$(PYTHON) -m examples.demo_live

# A suite that passes without the kernel tests only half of the package. Where there is no C compiler:
# make test DEEP_NRSFM_REQUIRE_KERNEL=0
test: export DEEP_NRSFM_REQUIRE_KERNEL = 1
test: lint
	$(PYTHON) -m pytest $(if $(filter-out 1,$(TEST_PROCESSES)),-n $(TEST_PROCESSES) --dist loadfile --no-loadscope-reorder)

lint: $(READY)
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m mypy --num-workers auto

docs: $(READY)
	$(PYTHON) -m sphinx -W --keep-going -q -b html docs build/site
	@echo build/site/index.html

reference: $(READY)
	$(PYTHON) -m docs.generate

# Beside the kernel of .venv, not in its place. Python's allocator would hide what ASan looks for, and Python
# itself leaks.
sanitize: $(READY)
ifeq ($(wildcard $(LIBASAN)),)
	@echo "make sanitize: NOT RUN, since $(SANITIZE_CC) has no libasan.so"
else
	rm -rf build/sanitize
	CC=$(SANITIZE_CC) CFLAGS="$(SANITIZERS)" LDFLAGS="$(SANITIZERS)" DEEP_NRSFM_REQUIRE_KERNEL=1 $(PYTHON) setup.py -q build \
	    --build-base build/sanitize --build-lib build/sanitize/lib
	LD_PRELOAD="$(LIBASAN) $(LIBSTDCXX)" ASAN_OPTIONS=detect_leaks=0:quarantine_size_mb=16:allocator_may_return_null=1 UBSAN_OPTIONS=print_stacktrace=1 PYTHONMALLOC=malloc \
	    DEEP_NRSFM_REQUIRE_KERNEL=1 FUZZ=$(SANITIZE_FUZZ) $(PYTHON) -m pytest -q --capture sys -p no:cacheprovider \
	    -o pythonpath="build/sanitize/lib ." --timeout 0 $(SANITIZE_TESTS)
endif

fuzz: $(READY)
	FUZZ=100000 $(PYTHON) -m pytest test/fuzz

benchmark: $(READY)
	@test -n "$(DATA)" || { echo "make benchmark DATA=DIR: DIR holds cmu/ and nrsfm/"; exit 2; }
	set -e; for name in $(BENCHMARKS); do \
	    $(PYTHON) -m benchmarks.$$name --data $(DATA) --output runs/benchmarks; done

benchmark-speed: $(READY)
	set -e; for name in $(SPEED); do $(PYTHON) -m benchmarks.$$name; done
	test -z "$(DATA)" || $(PYTHON) -m benchmarks.speed.time_to_error --data $(DATA)

python-version:
	@$(PYTHON3) -c 'import sys; (3, 11) <= sys.version_info < (3, 14) or sys.exit( \
	    "Python 3.11 to 3.13 is needed and $(PYTHON3) is %d.%d; choose one: " \
	    "make PYTHON3=python3.12" % sys.version_info[:2])'

# Editable, so that a stale copy never shadows the source; the tests install real copies elsewhere.
$(READY): requirements.lock setup.py | python-version
	$(PYTHON3) -m venv .venv
	$(PYTHON) -m pip install --requirement requirements.lock
	$(PYTHON) -m pip install --no-deps --no-build-isolation --editable .
	touch $@

$(DEMO_READY): requirements.lock setup.py | python-version
	$(PYTHON3) -m venv .venv
	$(PYTHON) -m pip install --quiet --constraint requirements.lock setuptools
	$(PYTHON) -m pip install --quiet --constraint requirements.lock --no-build-isolation --editable '.[ros,train,demo]'
	touch $@

$(EXAMPLES_READY): $(READY)
	@$(PYTHON) -c 'import sys; sys.version_info < (3, 13) or sys.exit( \
	    "MediaPipe 0.10.14 is made for Python 3.11 to 3.12 and .venv has %d.%d; choose one: " \
	    "rm -rf .venv; make PYTHON3=python3.12 demo-live" % sys.version_info[:2])'
	$(PYTHON) -m pip install --constraint requirements.lock --no-build-isolation --editable '.[examples]'
	touch $@

# In an environment of its own: what it needs is nothing that we need.
audit:
	$(PYTHON3) -m venv build/audit
	build/audit/bin/pip install --quiet pip-audit
	build/audit/bin/pip-audit --strict --requirement requirements.lock --no-deps --disable-pip

# Left out: the CUDA wheels, which torch itself pins, on the machines that want them.
lock:
	rm -rf build/lock && $(LOCK_PYTHON) -m venv build/lock
	build/lock/bin/pip install --quiet --dry-run --ignore-installed \
	    --report build/lock/report.json '.[train,ros,test,benchmarks,docs,demo]' '$(LOCK_TORCH)'
	build/lock/bin/python -c 'import json; \
	    found = [i["metadata"] for i in json.load(open("build/lock/report.json"))["install"]]; \
	    pins = {m["name"]: m["version"].split("+")[0] for m in found}; \
	    skip = ("deep_nrsfm_ros", "cuda-", "nvidia-", "triton"); \
	    print("# Made by `make lock` from setup.py; do not edit."); \
	    [print(f"{n}=={pins[n]}") for n in sorted(pins, key=str.lower) if not n.startswith(skip)]' \
	    > build/lock/requirements.lock
	mv build/lock/requirements.lock requirements.lock
	build/lock/bin/pip install --quiet uv
	build/lock/bin/uv pip compile setup.py --extra ros --extra hdf5 --extra demo --universal --generate-hashes \
	    --python-version 3.11 --quiet --custom-compile-command "make lock" -o requirements.hashes.lock

clean:
	rm -rf build dist .hypothesis .pytest_cache .ruff_cache .mypy_cache
	rm -rf *.egg-info
	find deep_nrsfm_ros benchmarks examples test launch -name __pycache__ -type d -prune -exec rm -rf {} +

clean-demo:
	rm -rf demo_output
