# `make` without a target lists the targets.
# deploy/native.py provides the native libraries to the recipes that need them: the first call
# downloads, later calls print the path. ORT_DYLIB_PATH, LIBTORCH and GRASPD_PYTHON override it.

CARGO_TARGET_DIR ?= target
CARGO ?= cargo
PYTHON ?= python3
export CARGO_TARGET_DIR

# Everything but grasp-train, which needs libtorch.
WORKSPACE = --workspace --exclude grasp-train --locked
TRAIN = --package grasp-train --locked
# Compiles sooner than a release; what computes is optimised as well.
DEBUG = $(CARGO_TARGET_DIR)/debug
RELEASE = $(CARGO_TARGET_DIR)/release

# Prefixes of commands. A recipe stops if the library or program is not available.
with_onnxruntime = ORT_DYLIB_PATH="$$($(PYTHON) deploy/native.py onnxruntime)" && export ORT_DYLIB_PATH &&
with_python = GRASPD_PYTHON="$$($(PYTHON) tests/tools.py python)" && export GRASPD_PYTHON &&
with_libtorch = LIBTORCH="$$($(PYTHON) deploy/native.py libtorch)" && export LIBTORCH && \
	LD_LIBRARY_PATH="$$LIBTORCH/lib$${LD_LIBRARY_PATH:+:$$LD_LIBRARY_PATH}" && export LD_LIBRARY_PATH &&


.PHONY: help demo build install wheel test test-some test-ros2 fmt lint doc deny test-faults fuzz bench-sim bench-gpu bench-serve soak tables clean

help: ## list the targets
	@sed -n 's/^\([a-z0-9-]*\):[^#]*## \(.*\)/\1|\2/p' $(MAKEFILE_LIST) | awk -F'|' '{ printf "  make %-12s %s\n", $$1, $$2 }'

demo: ## simulate a cluttered table, detect grasps with the server, execute the best, draw demo.png
	$(with_onnxruntime) $(CARGO) build --package graspd --package grasp-sim --locked && \
		$(DEBUG)/grasp-sim demo --graspd $(DEBUG)/graspd --models models/zoo --seed 3 --picture demo.png

build: ## build the server, the simulator and the client, optimised
	$(CARGO) build --release $(WORKSPACE)

test: ## all checks that a change must pass
	$(PYTHON) tests/run.py

wheel: ## build the wheels of the Python client and of the programs into dist/
	$(PYTHON) deploy/wheels.py

PREFIX ?= $(HOME)/.local
install: build ## install the programs and the models into PREFIX (~/.local)
	install -D --target-directory $(PREFIX)/bin $(RELEASE)/graspd $(RELEASE)/grasp $(RELEASE)/grasp-sim
	mkdir -p $(PREFIX)/share/graspd
	cp -r --no-target-directory models/zoo $(PREFIX)/share/graspd/models
	$(PYTHON) deploy/native.py onnxruntime

fmt: ## format the code
	$(CARGO) fmt --all

lint: ## run clippy; warnings are errors
	$(with_libtorch) $(CARGO) clippy --workspace --locked --all-targets -- -D warnings

doc: ## build the documentation; broken links are errors
	$(with_libtorch) RUSTDOCFLAGS="-D warnings" $(CARGO) doc --no-deps --workspace --locked

deny: ## check licences, advisories and sources of the dependencies (needs cargo-deny)
	$(CARGO) deny check

test-some: ## compile, and run the tests whose names contain NAME: make test-some NAME=python
	$(PYTHON) tests/run.py $(NAME)

test-ros2: ## test the ROS 2 packages of ros2/ with ROS 2 from PyPI; TEST="-k NAME" selects tests
	$(with_libtorch) $(CARGO) build --workspace --locked --bins
	$(with_onnxruntime) GRASPD_ROS2="$$($(PYTHON) tests/tools.py ros2)" && \
		GRASPD="$(DEBUG)/graspd" GRASP_SIM="$(DEBUG)/grasp-sim" \
		"$$GRASPD_ROS2" tests/ros2/run.py $(TEST)

test-faults: ## run the test that `test` excludes: ten thousand connections
	$(with_libtorch) $(CARGO) build --workspace --locked --bins
	$(with_onnxruntime) $(with_libtorch) $(CARGO) test --workspace --locked --test it faults -- --ignored --nocapture

fuzz: ## fuzz the decoders of volumes, views and model files, twenty million inputs each (needs cargo-fuzz)
	for target in request views model; do RUSTC_BOOTSTRAP=1 $(CARGO) fuzz run --fuzz-dir tests/fuzz \
		--target-dir $(CARGO_TARGET_DIR)/fuzz --sanitizer none $$target -- -runs=20000000 -max_len=4096 || exit; done

bench-sim: ## measure how fast scenes are generated, rendered and labelled on one core
	$(CARGO) run --release --package grasp-sim --example speed --locked

bench-gpu: ## measure latency and throughput of the server on an NVIDIA GPU, beside PyTorch (PYTORCH=python with torch and onnx)
	$(CARGO) build --release $(WORKSPACE) --bins --example gpu
	$(with_libtorch) $(CARGO) build --release $(TRAIN)
	mkdir -p $(CARGO_TARGET_DIR)/bench-gpu
	$(with_libtorch) $(RELEASE)/grasp-train init --network transformer --orientation axes \
		--out $(CARGO_TARGET_DIR)/bench-gpu/transformer.onnx
	$(RELEASE)/grasp-sim label --scene packed --scenes 1 --points 1 --seed 51 --format processed \
		--out $(CARGO_TARGET_DIR)/bench-gpu/scene
	ORT_DYLIB_PATH="$$($(PYTHON) deploy/native.py onnxruntime-gpu)" $(RELEASE)/examples/gpu $(RELEASE)/graspd \
		$(CARGO_TARGET_DIR)/bench-gpu/scene/scenes/s00000000.npz 3 $(CARGO_TARGET_DIR)/bench-gpu/results.json \
		$(CARGO_TARGET_DIR)/bench-gpu/transformer.onnx models/zoo/vgn-packed.onnx
	if [ "$(PYTORCH)" ]; then for model in $(CARGO_TARGET_DIR)/bench-gpu/transformer.onnx models/zoo/vgn-packed.onnx; do \
		for precision in fp16 fp32; do $(PYTORCH) tests/peers/pytorch_latency.py $$model --precision $$precision \
			--batches 1,4,16,64 --compiled 1,64; done; done; fi

bench-serve: ## measure latency and throughput of the server, libtorch, OpenVINO, Triton and a Python server (idle machine only)
	$(CARGO) build --release $(WORKSPACE) --bins
	$(CARGO) build --release $(WORKSPACE) --example serve
	$(with_libtorch) $(CARGO) build --release $(TRAIN)
	$(with_onnxruntime) $(with_libtorch) GRASPD_PEERS="$$($(PYTHON) tests/tools.py peers)" && export GRASPD_PEERS && \
		GRASP_TRAIN=$(RELEASE)/grasp-train $(RELEASE)/examples/serve 5 $(CARGO_TARGET_DIR)/bench-serve.json

soak: ## load test: four times the sustainable load, also with deadlines, then 80 % of it for 20 minutes; MINUTES=N
	$(CARGO) build --release $(WORKSPACE) --bins
	$(CARGO) build --release $(WORKSPACE) --example soak
	$(with_onnxruntime) $(RELEASE)/examples/soak $(MINUTES)

tables: ## measure the paper's tables, write docs/tables.md; VGN=DIR adds VGN's released weights, OBJECTS=DIR other objects
	$(CARGO) build --release --package graspd --package grasp-sim --locked
	$(with_onnxruntime) $(with_python) \
		"$$GRASPD_PYTHON" -m pip install --quiet --no-index --no-deps --no-build-isolation --upgrade \
			--target $(CARGO_TARGET_DIR)/pybullet ./client/python && \
		PYTHONPATH=$(CARGO_TARGET_DIR)/pybullet $(RELEASE)/grasp-sim tables --pybullet "$$GRASPD_PYTHON" \
			--graspd $(RELEASE)/graspd $(if $(VGN),--released $(VGN)) $(if $(OBJECTS),--objects $(OBJECTS))

clean: ## remove build outputs; downloads are kept
	$(CARGO) clean
	rm -f demo.png
