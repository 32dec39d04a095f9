# `make demo` and `make test` set everything up by themselves in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
export OMP_WAIT_POLICY ?= passive

.PHONY: demo test lint types bench clean train-prior train-progress train-stop
MOTION_DIR ?= ../shared/motion
THREADS ?= 1

$(VENV)/.run: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet -c constraints.txt -e .
	touch $@

$(VENV)/.dev: $(VENV)/.run
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[dev,viewer]"
	touch $@

demo: $(VENV)/.run
	$(BIN)/video2anim demo --out demo_out

test: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/python -m pytest -q

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev
	$(BIN)/pyright

bench: $(VENV)/.dev
	$(BIN)/python benchmarks/v2a_bench.py $(if $(MOTION),--motion $(MOTION))

# The networks' training run, in the background, from where it was; MINUTES=30 stops by itself.
train-prior: $(VENV)/.dev
	$(BIN)/python training/prior.py start --motion $(MOTION_DIR) --threads $(THREADS) $(if $(MINUTES),--minutes $(MINUTES))

train-progress:
	@$(BIN)/python training/prior.py progress

train-stop:
	@$(BIN)/python training/prior.py stop

clean:
	rm -rf $(VENV) demo_out dist build
