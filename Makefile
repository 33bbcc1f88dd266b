# Two commands show and check everything that a user needs on a fresh Debian or Ubuntu machine: `make demo` and `make test`. `make help` lists
# the rest.
#
# Everything is built by one profile (release), and all checks name the same packages and features: so llama.cpp, and for the tests
# HiGHS, are compiled once.

SHELL := /usr/bin/env bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.NOTPARALLEL:

# rustup puts cargo here; a shell that was open before does not have it on its path.
export PATH := $(PATH):$(or $(CARGO_HOME),$(HOME)/.cargo)/bin
TARGET := $(or $(CARGO_TARGET_DIR),target)
VENV := $(TARGET)/python
ROUTER := $(TARGET)/zenoh
# Tests compile our own crates with little optimisation: in two thirds of the time, and on the same builds of all others.
light = --config 'profile.release.package.$(1).opt-level=1' --config 'profile.release.package.$(1).codegen-units=16'
OWN := $(addprefix roomcast-,core services ipc llama lab ros2 simulation cli database) roomcast
TESTS := --release --locked --workspace --features full $(foreach crate,$(OWN),$(call light,$(crate)))
ZENOH := --release --locked --manifest-path zenoh/Cargo.toml --target-dir $(abspath $(TARGET))
# Clippy's compiler and the wrapper of rustdoc build what the tests run. `cargo clippy` and `cargo doc` would check all dependencies a second time.
CHECKED := RUSTC_WORKSPACE_WRAPPER=clippy-driver CLIPPY_ARGS=-D__CLIPPY_HACKERY__warnings__CLIPPY_HACKERY__ RUSTDOC=$(abspath .ci/rustdoc)

.PHONY: help
help: ## Lists the commands.
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{ printf "  make %-14s %s\n", $$1, $$2 }'

.PHONY: setup
setup: ## Installs what is missing, or says what to install.
	@.ci/setup

.PHONY: build
build: setup ## Builds the roomcast binary.
	@echo "build: the first build compiles llama.cpp and takes some minutes on two cores, later ones seconds"
	cargo build --release --locked

.PHONY: lab
lab: setup ## Builds roomcast-lab, the program with the experiments.
	cargo build --release --locked --package roomcast-lab

.PHONY: demo
demo: build ## Builds, then shows the whole system at work on this machine.
	$(TARGET)/release/roomcast demo

.PHONY: check
check: ## Before a commit: format, lints and unit tests of the crates that you changed.
	@.ci/check

.PHONY: test
test: setup format counts prose structure lint unit docs licences scenes python ## Format, lints, tests, documentation, licences, Python.
	@echo "test: all checks passed (target/release/roomcast is a slower one for tests now: make build)"

.PHONY: test-full
test-full: setup full seeds lint-benches zenoh clients ## The tests that take longer or need more: zenoh, brokers, browser, systemd, chaos, failing system calls, more seeds.
	@echo "test-full: all checks passed"

.PHONY: format
format:
	@echo "test: format"
	cargo fmt --all --check
	cargo fmt --manifest-path zenoh/Cargo.toml --check
	cargo fmt --manifest-path clients/rust/Cargo.toml --check

.PHONY: structure
structure: ## Prints the tree, the crates' dependencies and what each build compiles; fails when a crate uses what it may not.
	@.ci/structure

.PHONY: figures
figures: ## Prints lines, the largest file and function, and public items of each crate, before and now.
	@.ci/figures

.PHONY: sizes
sizes: build lab ## Prints the size of each program and the packages of each build, before and now; fails above a budget.
	@.ci/sizes

.PHONY: lint
lint:
	@echo "test: lints (the first run compiles all tests: some minutes on two cores)"
	@$(CHECKED) cargo test $(TESTS) --lib --bins --tests --examples --no-run

.PHONY: unit
unit:
	@echo "test: unit and property tests, and one test of each kind of process"
	@$(CHECKED) ROOMCAST_SEEDS=250 .ci/tests fast $(TESTS)

.PHONY: full
full:
	@echo "test-full: the tests that are marked as full"
	@$(CHECKED) .ci/tests full $(TESTS)

.PHONY: seeds
seeds:
	@echo "test-full: more seeds"
	@$(CHECKED) ROOMCAST_FIRST_SEED=250 ROOMCAST_SEEDS=750 cargo test $(TESTS) --test it simulated::no_seed

.PHONY: lint-benches
lint-benches:
	@echo "test-full: lints of the benchmarks"
	@$(CHECKED) cargo build $(TESTS) --benches

# A workspace of its own, in the same target folder (zenoh/Cargo.toml says why). Its tests start the robot's program, and zenoh's router from PyPI.
.PHONY: zenoh
zenoh: setup ## Builds and checks roomcast-zenoh: lints, tests with a real router, documentation.
	@echo "test: roomcast-zenoh (its first build compiles zenoh: some minutes on two cores)"
	test -x $(TARGET)/release/roomcast || cargo build --release --locked
	$(CHECKED) cargo test $(ZENOH) --lib --bins --tests --examples --no-run
	@test -x $(ROUTER)/bin/python || python3 -m venv $(ROUTER); \
	if ! $(ROUTER)/bin/python -c 'import mcap_ros2, rosbags, zenoh, zenoh_ros2_sdk' 2>/dev/null; then \
	    $(ROUTER)/bin/python -m pip install --quiet --disable-pip-version-check 'eclipse-zenoh==1.10.2' 'mcap-ros2-support==0.6.0' 'rosbags==0.11.9' 'zenoh-ros2-sdk==0.1.8' || true; \
	fi
	$(CHECKED) .ci/tests fast $(ZENOH)
	$(CHECKED) cargo test $(ZENOH) --doc

.PHONY: nightly
nightly: setup ## An hour of faults by seed: simulation, killed processes, failing system calls, brokers, mutated input; says what was tried. Then the fleet's.
	@# The fleet's faults are tried whatever became of the others; a violation counts for more than a kind that could not be tried (3).
	@code=0; .ci/nightly || code=$$?; \
	PROPTEST_CASES=5000 cargo test $(ZENOH) --test it hostile:: || code=1; \
	ROOMCAST_FLEET_CYCLES=300 ROOMCAST_FLEET_SEED=$$(date +%j) ROOMCAST_FLEET_CUT_S=60 cargo test $(ZENOH) --test it fleet:: -- --nocapture || code=1; \
	exit $$code

.PHONY: test-home
test-home: setup ## The test with a real Home Assistant, 2024.3.3 and the newest, which it installs first: minutes, 2 GB, Python 3.11 and 3.14.
	@.ci/test-home

# Each fault compiles the crates above it again, so this takes long.
.PHONY: faults
faults: setup ## Puts old faults back, one after another, and prints whether a unit test finds each; fails if one is missed.
	@.ci/faults

.PHONY: docs
docs:
	@echo "test: documentation and its examples"
	@$(CHECKED) cargo test $(TESTS) --doc

.PHONY: book
book: ## Builds the manual as web pages, into target/book (mdBook, which it builds first).
	@.ci/book

.PHONY: licences
licences:
	@echo "test: licences, bans and sources of the dependencies"
	@.ci/deny licenses bans sources

.PHONY: audit
audit: setup ## Checks the dependencies: licences, sources, bans, and the RustSec advisories where they can be reached.
	@.ci/deny licenses bans sources advisories

# What counts tests is itself tested.
.PHONY: counts
counts:
	@echo "test: what counts the tests"
	python3 -m unittest discover -v -s .ci

.PHONY: prose
prose: ## Counts the roundabout words of manuals and comments; fails above a budget.
	@.ci/prose

.PHONY: scenes
scenes:
	@if ! python3 -c 'import tomllib' 2>/dev/null; then \
	    echo "SKIPPED scenes: furnishing them needs Python 3.11"; \
	    exit 0; \
	fi; \
	echo "test: scenes"; \
	python3 scenes/furnish.py --check; \
	python3 -m unittest discover -v -s scenes

# The Python parts: the tests of the training pipeline that need no PyTorch, of the recorded homes' translation, and the client package where
# it can be installed.
.PHONY: python
python:
	@# Prints the layouts that the client is compared with.
	@$(CHECKED) cargo build $(TESTS) --example layout
	@if ! compgen -G 'training/tests/test_*.py' >/dev/null && ! compgen -G 'benches/homes/test_*.py' >/dev/null && \
	    ! compgen -G 'clients/python/tests/test_*.py' >/dev/null; then \
	    exit 0; \
	fi; \
	echo "test: Python parts"; \
	test -x $(VENV)/bin/python || python3 -m venv $(VENV); \
	if ! $(VENV)/bin/python -c 'import hypothesis, mcap, pytest' 2>/dev/null && \
	   ! $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check 'pytest==8.4.2' 'numpy==2.3.3' 'mcap==1.6.0' 'hypothesis==6.170.15'; then \
	    echo "SKIPPED Python parts: pytest cannot be installed (no network?)"; \
	    exit 0; \
	fi; \
	if compgen -G 'training/tests/test_*.py' >/dev/null; then \
	    $(VENV)/bin/python -m pytest -q -rs training/tests || [ $$? = 5 ]; \
	fi; \
	if compgen -G 'benches/homes/test_*.py' >/dev/null; then \
	    $(VENV)/bin/python -m pytest -q -rs benches/homes || [ $$? = 5 ]; \
	fi; \
	ROOMCAST=$(abspath $(TARGET))/release/roomcast $(VENV)/bin/python -m pytest -q -rs clients/captions; \
	if compgen -G 'clients/python/tests/test_*.py' >/dev/null; then \
	    if $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check -e clients/python; then \
	        ROOMCAST=$(abspath $(TARGET))/release/roomcast $(VENV)/bin/python -m pytest -q -rs clients/python/tests; \
	    else \
	        echo "SKIPPED the Python client: iceoryx2 cannot be installed from PyPI (no network?)"; \
	    fi; \
	fi

.PHONY: clients
clients: setup ## Tries users' programs with a daemon: in Rust with the packaged crate, in Python with the wheel, and an earlier Python client.
	test -x $(TARGET)/release/roomcast || cargo build --release --locked
	@.ci/clients

.PHONY: known-scores
known-scores: build ## After a change of the embedded model: records the scores that it is known for.
	$(TARGET)/release/roomcast model check --record models/household-check.json

.PHONY: c-header
c-header: ## After a change of the messages: writes clients/c/roomcast.h.
	ROOMCAST_WRITE_HEADER=1 cargo test --release --locked --package roomcast-ipc --test it c_header::

.PHONY: deb
deb: setup ## Builds the Debian package, portable across processors.
	@.ci/deb

.PHONY: dist
dist: setup ## Builds all artefacts of a release into target/dist: tarball, Debian package, wheels, crates, add-on, sums.
	@.ci/dist

.PHONY: dist-aarch64
dist-aarch64: setup ## The same for 64-bit Arm, cross-compiled, then tried under emulation (needs g++-aarch64-linux-gnu and qemu-user).
	@.ci/dist aarch64
	@.ci/check-aarch64

.PHONY: trials
trials: ## Tries each artefact of target/dist as its user would, in fresh systems and Python environments, and prints a table.
	@.ci/trials

.PHONY: clean
clean: ## Removes everything that was built.
	cargo clean
