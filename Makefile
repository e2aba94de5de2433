# make demo    a first look: serves a small trained checkpoint, scores clips, draws their curves
# make test    lint, types, generated files, and the tests that take minutes
# make test-all    all that CI runs: also what kills, waits, restarts, or needs programs of Debian
# make ops-check    what runs around the server: alerts, dashboards, containers, Kubernetes
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/installed
TOOL := PYTHONPATH=tests/support:tools/faults $(BIN)/python

.PHONY: demo test test-all check parity rollout bench bench-full perf chaos chaos-full soak format model_repository clean \
  ops-check ops-tools audit lock mutate

demo: $(INSTALLED)
	$(BIN)/python examples/demo.py

test: check
	$(BIN)/pytest -m "not gpu and not slow"

# The tests that kill, wait and restart, and those that need programs of Debian, too.
test-all: check ops-tools
	$(BIN)/pytest

check: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/rfm export --check --repository model_repository --config model_repository/serve.yaml

# Every reference case through Triton: how far are the scores from the original's?
parity: $(INSTALLED)
	$(TOOL) tools/parity.py

# Two versions take turns while 32 callers ask, half over gRPC and half over HTTP: is a request lost?
rollout: $(INSTALLED)
	$(TOOL) tools/faults/rollout.py

# This server beside the bare engine, the FastAPI server's design, LitServe and mosec, in one run.
bench: $(INSTALLED)
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[bench]"
	$(BIN)/python benchmarks/bench.py

# All loads (half an hour), and the engine without a server: beside the original's forward, and as the work grows.
bench-full: $(INSTALLED)
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[bench]"
	$(BIN)/python benchmarks/forward.py
	$(BIN)/python benchmarks/bench.py --full

# Triton's own perf_analyzer on checkpoints of both sizes.
perf: $(INSTALLED)
	$(BIN)/python benchmarks/perf_analyzer.py --size small
	$(BIN)/python benchmarks/perf_analyzer.py --size default

# Faults while callers ask: processes killed and stopped, full memory and disks, overload, broken requests, killed exports.
chaos: $(INSTALLED)
	$(TOOL) tools/faults/chaos.py
	$(TOOL) tools/faults/fuzz.py
	$(TOOL) tools/faults/kill_export.py --kills 10

# The same with 100 killed exports. A quarter of an hour.
chaos-full: $(INSTALLED)
	$(TOOL) tools/faults/chaos.py
	$(TOOL) tools/faults/fuzz.py
	$(TOOL) tools/faults/kill_export.py --kills 100

# Half an hour at half of what can be served: do memory and latency stay?
soak: $(INSTALLED)
	$(TOOL) tools/faults/chaos.py --soak

# Do the tests see small faults? 220 changes of one operator, constant, index or branch, each tried by the tests of its
# file. Three quarters of an hour on two cores.
mutate: $(INSTALLED)
	$(TOOL) tools/mutation/mutate.py

# What docker/ holds, as far as it can be checked without a container engine or a cluster: alerts and recording rules on
# made-up series, they and the dashboard on a live Prometheus and Triton; Dockerfile and compose file; Kubernetes.
ops-check: ops-tools
	$(BIN)/pytest tests/ops

# Programs of Debian and Ubuntu that tests run. Prometheus is unpacked into $(VENV): installed, it starts a service.
AS_ROOT = $(shell if [ "$$(id -u)" = 0 ]; then :; elif sudo -n true 2>/dev/null; then echo sudo -n; else echo false; fi)
MISSING = { echo "make ops-tools: expected $(1) in PATH, got none; install it (Debian, Ubuntu: $(2))" >&2; exit 1; }

ops-tools: $(INSTALLED)
	@test -x $(BIN)/promtool || { command -v promtool && command -v prometheus; } >/dev/null || \
	  { $(AS_ROOT) apt-get update -qq; cd $(VENV) && apt-get -qq -o APT::Sandbox::User=root download prometheus && \
	  dpkg-deb --fsys-tarfile prometheus_*.deb | \
	  tar -x -C bin --strip-components=3 ./usr/bin/prometheus ./usr/bin/promtool && rm prometheus_*.deb; } || \
	  $(call MISSING,prometheus and promtool,apt-get install prometheus)
	@docker compose version >/dev/null 2>&1 || command -v docker-compose >/dev/null || \
	  { $(AS_ROOT) apt-get update -qq && \
	  $(AS_ROOT) apt-get install --yes -qq --no-install-recommends docker-compose; } || \
	  $(call MISSING,docker-compose,apt-get install docker-compose)

# Known vulnerabilities of the pinned packages, as PyPI tells them: a report, which needs the network.
audit: $(INSTALLED)
	$(PYTHON) -m venv $(VENV)/audit
	$(VENV)/audit/bin/pip install --quiet --disable-pip-version-check pip-audit
	$(VENV)/audit/bin/pip-audit --strict --requirement constraints.txt --no-deps --disable-pip

# Writes docker/requirements.txt: hashes of what the image installs, for constraints.txt as it is. Needs the network.
lock:
	$(PYTHON) -m venv $(VENV)/lock
	$(VENV)/lock/bin/pip install --quiet --disable-pip-version-check uv
	{ echo '# What the image installs beside torch, in the versions of constraints.txt, with the hashes of all files.'; \
	  echo '# Made by: make lock'; \
	  echo '# Not here: torch, whose build and so whose hash depends on TORCH_INDEX, and what only torch needs.'; \
	  printf 'torch\nrfm-client\nrfm-gateway\n' | $(VENV)/lock/bin/uv pip compile --quiet --no-python-downloads --no-header \
	  --no-annotate --universal --python-version 3.10 --generate-hashes --constraints constraints.txt --excludes - \
	  --extra encoders --extra vlm client/pyproject.toml gateway/pyproject.toml pyproject.toml; } > $(VENV)/lock/requirements.txt
	mv $(VENV)/lock/requirements.txt docker/requirements.txt

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Trains the demo's checkpoint anew and exports it as version 1. Takes a quarter of an hour.
model_repository: $(INSTALLED)
	rm -rf build/demo_checkpoint
	$(BIN)/python examples/train_demo_checkpoint.py build/demo_checkpoint
	rm -rf model_repository/rfm model_repository/rfm_encoder model_repository/rfm_frames
	$(BIN)/rfm export --repository model_repository --config model_repository/serve.yaml \
	  --checkpoint build/demo_checkpoint/checkpoint \
	  --image-encoder build/demo_checkpoint/image_encoder --text-encoder build/demo_checkpoint/text_encoder

$(INSTALLED): pyproject.toml client/pyproject.toml gateway/pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt torch
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt \
	  --editable "client[cli,gym]" --editable gateway --editable ".[encoders,vlm,triton,demo,dev]"
	touch $@

clean:
	rm -rf $(VENV) build client/build demo_output
