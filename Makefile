# make demo    a first look: serves a small trained checkpoint, scores clips, draws their curves
# make test    everything that CI runs: lint, types, generated files, tests
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/installed

.PHONY: demo test check parity bench perf format model_repository clean

demo: $(INSTALLED)
	$(BIN)/python examples/demo.py

test: check
	$(BIN)/pytest

check: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/rfm export --check --repository model_repository --config model_repository/serve.yaml

# Every reference case through Triton: how far are the scores from the original's?
parity: $(INSTALLED)
	$(BIN)/python tests/parity.py

# This server beside the bare engine, the FastAPI server's design, LitServe and mosec, in one run.
bench: $(INSTALLED)
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[bench]"
	$(BIN)/python benchmarks/bench.py

# Triton's own perf_analyzer on the committed repository.
perf: $(INSTALLED)
	$(BIN)/python benchmarks/perf_analyzer.py

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Trains the demo's checkpoint anew and exports it as version 1. Takes half an hour.
model_repository: $(INSTALLED)
	rm -rf build/demo_checkpoint
	$(BIN)/python examples/train_demo_checkpoint.py build/demo_checkpoint
	rm -rf model_repository/rfm model_repository/rfm_encoder model_repository/rfm_frames
	$(BIN)/rfm export --repository model_repository --config model_repository/serve.yaml \
	  --checkpoint build/demo_checkpoint/checkpoint \
	  --image-encoder build/demo_checkpoint/image_encoder --text-encoder build/demo_checkpoint/text_encoder

$(INSTALLED): pyproject.toml client/pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt torch
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt \
	  --editable "client[cli,gateway,gym]" --editable ".[encoders,vlm,triton,demo,dev]"
	touch $@

clean:
	rm -rf $(VENV) build client/build demo_output
