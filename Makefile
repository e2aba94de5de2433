PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
UV := 0.13.9
# Stamp files: what make demo runs is installed; everything is installed, which tests and tools need.
RUNS := $(VENV)/runs
INSTALLED := $(VENV)/installed
LEROBOT := $(VENV)/lerobot/installed
# What make test-newest prints, as the table of versions in docs/reference/configuration.md has it.
NEWEST := av|grpcio|gymnasium|h5py|huggingface-hub|lerobot|numpy|peft|pyarrow|stable-baselines3|tokenizers|torch|torchrl|transformers|tritonclient
WORKERS := --dist loadgroup --no-loadscope-reorder
TOOL := PYTHONPATH=tests/support:tools $(BIN)/python

# `make help` shows the first line of the comment above each target.
.PHONY: help demo install test fast test-more test-all nightly test-newest lint check types bench gpu gpu-packages perf chaos soak format model_repository \
  clean ops-check ops-tools audit lock mutate docs reference version

# What can be made: this list.
help:
	@awk '/^#/ { if (!comment) comment = substr($$0, 3); next } \
	  /^[a-z_-]+:/ { split($$1, target, ":"); printf "make %-18s%s\n", target[1], comment } { comment = "" }' Makefile

# A first look: serve a small trained checkpoint, score clips, draw their curves.
demo: $(RUNS)
	$(BIN)/python examples/demo.py

# Install everything into .venv, for tests, labels and RL, too. make test does it as well.
install: $(INSTALLED)

# Lint, generated files, and tests against a real Triton: four minutes.
test: $(INSTALLED)
	+$(MAKE) --jobs 2 lint fast

# The tests of make test, without lint.
fast: $(INSTALLED)
	$(BIN)/pytest --numprocesses 2 $(WORKERS) --durations 10 --durations-min 1 -m "not gpu and not alone and not slow and not debian and not nightly"

# The rest of CI: types, the documents, and the tests that are slow or need programs of Debian.
test-more: $(INSTALLED)
	+$(MAKE) --jobs 3 types docs ops-tools
	$(BIN)/pytest --numprocesses 3 $(WORKERS) --durations 10 -m "(slow or debian) and not gpu and not alone and not nightly"
	$(BIN)/pytest -m "alone and not nightly" $$(grep --recursive --files-with-matches mark.alone tests)

# All tests of CI.
test-all: test test-more

# What takes too long for CI: chaos, a cold install, every snippet of the documents, more reference cases.
# RFM_GOLDENS names a folder with more reference cases.
nightly: check ops-tools $(LEROBOT)
	$(BIN)/pytest --numprocesses 3 $(WORKERS) -m nightly
	$(if $(RFM_GOLDENS),$(BIN)/pytest -m reference)
	$(TOOL) tools/chaos.py

# Test with the newest packages that the index has, pinned or not, and beside LeRobot's own classes. Half an hour.
# Needs the network, Python 3.12 (uv gets it) and 12 GB. Triton's own Python keeps numpy 1. Prints the versions.
test-newest: $(INSTALLED) $(LEROBOT)
	$(BIN)/uv venv --quiet --clear --python 3.12 $(VENV)/newest
	$(UV_SETTINGS) $(BIN)/uv pip install --quiet --python $(VENV)/newest --editable "client[cli,rerun]" --editable apps/gateway \
	  --editable "apps/labels[hdf5,ray,rlds]" --editable apps/page --editable "apps/rl[sb3]" \
	  --editable ".[encoders,vlm,quantized,demo,dev]" torchrl
	$(BIN)/python tools/tritonserver.py $(VENV)/newest/server
	for environment in newest lerobot; do $(BIN)/uv pip list --python $(VENV)/$$environment | grep -E "^($(NEWEST)) "; done
	PATH=$(CURDIR)/$(VENV)/newest/server:$$PATH $(VENV)/newest/bin/pytest --numprocesses 2 $(WORKERS) \
	  -m "not gpu and not alone and not slow and not debian and not nightly" \
	  tests/client tests/contract tests/families tests/labels tests/rl
	$(BIN)/pytest -m nightly tests/families/test_lerobot_scores.py tests/rl/test_lerobot_itself.py

# Lint, format, generated files.
lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/rfm export --check --repository model_repository --config model_repository/serve.yaml

# Lint and types; no tests.
check: lint types

# Types alone.
types: $(INSTALLED)
	$(BIN)/mypy

# Measure this server beside the bare engine, the FastAPI server's design and mosec.
bench: $(INSTALLED)
	$(INSTALL) --editable ".[bench]"
	$(BIN)/python benchmarks/bench.py

# The packages from build/gpu.tar.xz if it exists, else those of $(VENV).
GPU_PYTHON = $(if $(wildcard build/gpu.tar.xz),$(PYTHON),$(BIN)/python)
EMPTY :=
SPACE := $(EMPTY) $(EMPTY)
GPU_PATH = $(subst $(SPACE),:,$(addprefix $(CURDIR)/,. client apps/gateway apps/labels export commands build/gpu/site))

# Measure on a GPU: GPU tests, the bare engine, served checkpoints. Ten minutes.
# Writes build/benchmarks/gpu.md. ARGUMENTS="--checkout build/gpu/before" measures the commit of make gpu-packages.
gpu:
	test ! -f build/gpu.tar.xz || $(PYTHON) -c "import tarfile; tarfile.open('build/gpu.tar.xz').extractall('build/gpu')"
	PYTHONPATH=$(GPU_PATH) $(GPU_PYTHON) benchmarks/gpu.py $(ARGUMENTS)

PLATFORMS := manylinux_2_35_x86_64 manylinux_2_28_x86_64 manylinux_2_17_x86_64 manylinux2014_x86_64

# Pack what a machine with Python 3.12, PyTorch and transformers lacks for make gpu into build/gpu.tar.xz, 35 MB.
# Needs the network. BEFORE=COMMIT also packs the packages of that commit. Unneeded files of the wheels are left out.
gpu-packages: $(INSTALLED)
	rm -rf build/gpu build/gpu.tar.xz
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-compile --target build/gpu/site \
	  --python-version 3.12 --implementation cp --only-binary :all: $(addprefix --platform ,$(PLATFORMS)) \
	  --constraint constraints.txt nvidia-pytriton numpy tritonclient python-rapidjson gymnasium farama-notifications
	cd build/gpu/site && find . -type d -name tests -prune -exec rm -r {} + && rm -r bin pytriton/tritonserver/caches \
	  nvidia_pytriton.libs/libpython3* $$(find pytriton/tritonserver/python_backend_stubs -mindepth 1 -type d ! -name 3.12)
	$(if $(BEFORE),mkdir build/gpu/before && git archive $(BEFORE) rfm client/rfm_client export/rfm_export commands | \
	  tar -x -C build/gpu/before && git rev-parse $(BEFORE) > build/gpu/before/COMMIT)
	git rev-parse HEAD > build/gpu/COMMIT
	tar -c -C build/gpu . | xz --x86 --lzma2=preset=9 > build/gpu.tar.xz
	ls -l build/gpu.tar.xz

# Measure with Triton's own perf_analyzer, checkpoints of both sizes.
perf: $(INSTALLED)
	$(BIN)/python benchmarks/perf_analyzer.py --size small --poisson 0.2
	$(BIN)/python benchmarks/perf_analyzer.py --size default

# Cause faults while callers ask, twelve minutes.
# Processes killed, stopped and hung, a crash loop, rollouts, a greedy caller, malformed requests.
chaos: $(INSTALLED)
	$(TOOL) tools/chaos.py

# Do memory and latency stay the same? Half an hour at half of the load that can be served.
soak: $(INSTALLED)
	$(TOOL) tools/chaos.py soak

# Do the tests see small faults? An hour or two.
# 200 changes of the wire, the collators, the networks and the batch model, made by cosmic-ray.
mutate: $(INSTALLED)
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python $(VENV)/mutate
	$(BIN)/uv pip install --quiet --python $(VENV)/mutate "cosmic-ray>=8.7,<9"
	$(VENV)/mutate/bin/python tools/mutate.py

# Test what docker/ holds: alerts, dashboard, image, compose file, Kubernetes.
# No container engine and no cluster are needed. Rules run on synthetic series, then on a live Prometheus and Triton.
ops-check: ops-tools
	$(BIN)/pytest tests/ops

AS_ROOT = $(shell if [ "$$(id -u)" = 0 ]; then :; elif sudo -n true 2>/dev/null; then echo sudo -n; else echo false; fi)

# Get the programs of Debian and Ubuntu that tests run, by the table in tests/support/debian.py.
# nginx and Prometheus are unpacked into $(VENV), since their packages start a service when they are installed.
ops-tools: $(INSTALLED)
	@missing=$$($(BIN)/python tests/support/debian.py); \
	test -z "$$missing" || $(AS_ROOT) apt-get update -qq; \
	for package in $$missing; do case $$package in \
	  nginx|prometheus) cd $(VENV) && apt-get -qq -o APT::Sandbox::User=root download $$package && \
	    dpkg-deb --fsys-tarfile $${package}_*.deb | tar -x -C bin --strip-components=3 --wildcards "./usr/*bin/*" && \
	    rm $${package}_*.deb && cd ..;; \
	  *) $(AS_ROOT) apt-get install --yes -qq --no-install-recommends $$package >/dev/null;; \
	esac || { echo "make ops-tools: expected Debian's package $$package, got none; put its programs into PATH" >&2; exit 1; }; done

# Build the documents as a site, build/site, with the Python API. A broken link is an error.
docs: | $(BIN)/uv
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python $(VENV)/docs
	$(BIN)/uv pip install --quiet --python $(VENV)/docs "mkdocs-material>=9.8,<10" "mkdocstrings[python]>=1,<2" ruff
	NO_MKDOCS_2_WARNING=1 $(VENV)/docs/bin/mkdocs build --strict --quiet

# Write the lists of docs/reference that come from the code.
reference: $(INSTALLED)
	$(BIN)/python tools/reference.py

# Report known vulnerabilities of the pinned packages. Needs the network.
audit: $(INSTALLED)
	$(BIN)/uv tool run --quiet pip-audit --strict --requirement constraints.txt --no-deps --disable-pip

# Write docker/requirements.txt: the hashes of the image's packages. Needs the network.
lock: | $(BIN)/uv
	{ echo '# What the image installs beside torch, in the versions of constraints.txt, with the hashes of all files.'; \
	  echo '# Made by: make lock'; \
	  echo '# Not here: torch, whose build and so whose hash depends on TORCH_INDEX, and what only torch needs.'; \
	  printf 'torch\nrfm-client\nrfm-gateway\nrfm-page\n' | $(BIN)/uv pip compile --quiet --no-python-downloads --no-header \
	  --no-annotate --universal --python-version 3.10 --generate-hashes --constraints constraints.txt --excludes - \
	  --extra encoders --extra vlm --extra quantized client/pyproject.toml apps/gateway/pyproject.toml apps/page/pyproject.toml pyproject.toml; } > $(VENV)/requirements.txt
	mv $(VENV)/requirements.txt docker/requirements.txt

PROJECTS := pyproject.toml client/pyproject.toml $(wildcard apps/*/pyproject.toml)
VERSIONED := $(PROJECTS) CITATION.cff docker/.env.example docker/compose.yaml \
  docker/kubernetes/kserve/kustomization.yaml $(wildcard docker/kubernetes/overlays/*/kustomization.yaml) docker/README.md

# Write a version into every file that names it: make version VERSION=1.2.3
version:
	sed -i "s/$$(sed -n 's/^version = "\(.*\)"/\1/; T; s/[.]/[.]/gp' pyproject.toml)/$(VERSION)/g" $(VERSIONED)

# Format the code.
format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Train the demo's checkpoint and export it as version 1, a quarter of an hour.
model_repository: $(INSTALLED)
	rm -rf build/demo_checkpoint
	$(BIN)/python examples/train_demo_checkpoint.py build/demo_checkpoint
	rm -rf model_repository/rfm model_repository/rfm_encoder model_repository/rfm_frames
	$(BIN)/rfm export --repository model_repository --config model_repository/serve.yaml \
	  --checkpoint build/demo_checkpoint/checkpoint \
	  --image-encoder build/demo_checkpoint/image_encoder --text-encoder build/demo_checkpoint/text_encoder

CHECK_PYTHON = 'import sys; own = sys.version_info[:2]; sys.exit("make: expected Python 3.10, 3.11 or 3.12, got %d.%d:" % own \
  + " make $(MAKECMDGOALS) PYTHON=python3.12" if not (3, 10) <= own <= (3, 12) else 0)'
PINS := pyproject.toml client/pyproject.toml $(wildcard apps/*/pyproject.toml) constraints.txt
# uv reads no settings of pip: a package index, folders of wheels and certificates are handed on.
PIP_SETTING = $(shell $(BIN)/pip config list | sed -n "s/^[^=]*[.]$(1)='\(.*\)'$$/$(2)=\1/p" | head -n 1)
UV_SETTINGS = $(call PIP_SETTING,index-url,UV_DEFAULT_INDEX) $(call PIP_SETTING,find-links,UV_FIND_LINKS) \
  $(call PIP_SETTING,cert,SSL_CERT_FILE)
INSTALL = $(UV_SETTINGS) $(BIN)/uv pip install --quiet --python $(BIN)/python --constraint constraints.txt

$(BIN)/uv:
	@$(PYTHON) -c $(CHECK_PYTHON)
	@echo "making $(VENV) ..."
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check uv==$(UV)

$(RUNS): $(PINS) | $(BIN)/uv
	@echo "installing 1.5 GB into $(VENV), with CUDA 5 GB (without a GPU: UV_TORCH_BACKEND=cpu make demo) ..."
	$(INSTALL) --editable "client[cli]" --editable apps/gateway --editable apps/page --editable ".[encoders,vlm,triton,demo]"
	touch $@

$(INSTALLED): $(PINS) | $(BIN)/uv
	$(INSTALL) --editable "client[cli,rerun]" --editable apps/gateway --editable "apps/labels[hdf5,ray,rlds]" \
	  --editable apps/page --editable "apps/rl[sb3]" --editable ".[encoders,vlm,quantized,triton,demo,dev]"
	touch $(RUNS) $@

# LeRobot, which needs Python 3.12, with the plug-in. mujoco: for its Meta-World 3.0
$(LEROBOT): client/pyproject.toml apps/rl/pyproject.toml | $(BIN)/uv
	$(BIN)/uv venv --quiet --clear --python 3.12 $(VENV)/lerobot
	$(UV_SETTINGS) $(BIN)/uv pip install --quiet --python $(VENV)/lerobot "lerobot[dataset,metaworld,robometer,topreward]" \
	  "mujoco<3.4" --editable client --editable "apps/rl[sb3]"
	touch $@

# Remove what make has made.
clean:
	rm -rf $(VENV) build client/build apps/*/build demo_output
