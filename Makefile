# Everything is one `make` target away; `make` alone lists them.
# Native libraries come from deploy/native.py, asked only by the recipes that need them: the first
# call downloads, the others print a path. ORT_DYLIB_PATH, LIBTORCH and GRASPD_PYTHON override it.

CARGO_TARGET_DIR ?= target
CARGO ?= cargo
PYTHON ?= python3
export CARGO_TARGET_DIR

# grasp-train alone needs libtorch, so it is always built by itself.
WORKSPACE = --workspace --exclude grasp-train --locked
TRAIN = --package grasp-train --locked
RELEASE = $(CARGO_TARGET_DIR)/release

# Put before a command. Each stops the recipe if it cannot be had.
with_onnxruntime = ORT_DYLIB_PATH="$$($(PYTHON) deploy/native.py onnxruntime)" && export ORT_DYLIB_PATH &&
with_python = GRASPD_PYTHON="$$($(PYTHON) tests/tools.py python)" && export GRASPD_PYTHON &&
# The real ones, which tests run.
with_programs = GRASPD_PROMETHEUS="$$($(PYTHON) tests/tools.py prometheus)" && export GRASPD_PROMETHEUS && \
	GRASPD_PROMTOOL="$$($(PYTHON) tests/tools.py promtool)" && export GRASPD_PROMTOOL && \
	GRASPD_CPP="$$($(PYTHON) tests/tools.py cpp)" && export GRASPD_CPP && \
	GRASPD_CHROMIUM="$$($(PYTHON) tests/tools.py chromium)" && export GRASPD_CHROMIUM &&
with_libtorch = LIBTORCH="$$($(PYTHON) deploy/native.py libtorch)" && export LIBTORCH && \
	LD_LIBRARY_PATH="$$LIBTORCH/lib$${LD_LIBRARY_PATH:+:$$LD_LIBRARY_PATH}" && export LD_LIBRARY_PATH &&

with_haproxy = GRASPD_HAPROXY="$$($(PYTHON) tests/tools.py haproxy)" && export GRASPD_HAPROXY &&

.PHONY: help demo build test fmt fmt-check lint doc deny test-rust test-train test-python test-faults fuzz bench-sim \
	bench-serve soak tables clean
# The order of test's parts is the order in which they fail fastest, also under `make -j`.
.NOTPARALLEL:

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):[^#]*## \(.*\)/\1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{ printf "  make %-12s %s\n", $$1, $$2 }'

demo: ## simulate a cluttered table, ask the server for grasps, execute the best, draw demo.png
	$(with_onnxruntime) $(CARGO) build --release --package graspd --package grasp-sim --locked && \
		$(RELEASE)/grasp-sim demo --graspd $(RELEASE)/graspd --models models/zoo --seed 3 --picture demo.png

build: ## build the server, the simulator and the client, optimised
	$(CARGO) build --release $(WORKSPACE)

test: fmt-check lint doc test-rust test-train ## everything a change must pass

fmt: ## format the code
	$(CARGO) fmt --all

fmt-check: ## check the format
	$(CARGO) fmt --all --check

lint: ## clippy, every warning an error
	$(CARGO) clippy $(WORKSPACE) --all-targets -- -D warnings
	$(with_libtorch) $(CARGO) clippy $(TRAIN) --all-targets -- -D warnings

doc: ## build the documentation, every broken link an error
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --no-deps $(WORKSPACE)
	$(with_libtorch) RUSTDOCFLAGS="-D warnings" $(CARGO) doc --no-deps $(TRAIN)

deny: ## check licences, advisories and sources of the dependencies (needs cargo-deny)
	$(CARGO) deny check

test-rust: ## test all but training, the Python client's end-to-end tests included
	$(with_onnxruntime) $(with_python) $(with_programs) $(CARGO) test $(WORKSPACE)

test-train: ## test training, in libtorch on the CPU
	$(with_onnxruntime) $(with_libtorch) $(CARGO) test $(TRAIN)

test-python: ## of test-rust, only the tests whose names say python
	$(with_onnxruntime) $(with_python) $(with_programs) $(CARGO) test $(WORKSPACE) python

test-faults: ## test what test leaves out: a replica killed behind haproxy, ten thousand connections
	$(with_onnxruntime) $(with_haproxy) $(CARGO) test --package grasp-tests --locked \
		--test replicas --test faults -- --ignored --nocapture

fuzz: ## send twenty million made-up volumes and as many views to their decoders (needs cargo-fuzz)
	for target in request views; do RUSTC_BOOTSTRAP=1 $(CARGO) fuzz run --fuzz-dir tests/fuzz \
		--target-dir $(CARGO_TARGET_DIR)/fuzz --sanitizer none $$target -- -runs=20000000 -max_len=4096 || exit; done

bench-sim: ## how fast scenes are made, seen and labelled on one core
	$(CARGO) run --release --package grasp-sim --example speed --locked

bench-serve: ## how fast the server answers, beside libtorch, OpenVINO, Triton and a server in Python; quiet machines only
	$(CARGO) build --release $(WORKSPACE) --bins
	$(CARGO) build --release $(WORKSPACE) --example serve
	$(with_libtorch) $(CARGO) build --release $(TRAIN)
	$(with_onnxruntime) $(with_libtorch) GRASPD_PEERS="$$($(PYTHON) tests/tools.py peers)" && export GRASPD_PEERS && \
		GRASP_TRAIN=$(RELEASE)/grasp-train $(RELEASE)/examples/serve 5 $(CARGO_TARGET_DIR)/bench-serve.json

soak: ## a minute of four times what the server can do, then 20 minutes of 80 % of it; MINUTES=N
	$(CARGO) build --release $(WORKSPACE) --bins
	$(CARGO) build --release $(WORKSPACE) --example soak
	$(with_onnxruntime) $(RELEASE)/examples/soak $(MINUTES)

tables: ## play the paper's tables into docs/tables.md; VGN=DIR adds VGN's released weights, OBJECTS=DIR other objects
	$(CARGO) build --release --package graspd --package grasp-sim --locked
	$(with_onnxruntime) $(with_python) \
		"$$GRASPD_PYTHON" -m pip install --quiet --no-index --no-deps --no-build-isolation --upgrade \
			--target $(CARGO_TARGET_DIR)/pybullet ./client/python && \
		PYTHONPATH=$(CARGO_TARGET_DIR)/pybullet $(RELEASE)/grasp-sim tables --pybullet "$$GRASPD_PYTHON" \
			--graspd $(RELEASE)/graspd $(if $(VGN),--released $(VGN)) $(if $(OBJECTS),--objects $(OBJECTS))

clean: ## remove what was built; what was downloaded stays
	$(CARGO) clean
	rm -f demo.png
