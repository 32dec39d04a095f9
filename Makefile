# `make demo` and `make test` set everything up by themselves in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
export OMP_WAIT_POLICY ?= passive
# Tests rewritten by pytest are kept: collecting them takes 11 s of CPU time per worker then, 26 s without.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test fast lint types bench clean train-prior train-progress train-stop
MOTION_DIR ?= ../shared/motion
THREADS ?= 1

$(VENV)/.run: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet -c constraints.txt -e .
	touch $@

$(VENV)/.dev: $(VENV)/.run
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[dev]"
	touch $@

# Programs that tests open exported files with; tests skip with a reason what cannot be had here. Blender's module for
# Python 3.11 needs numpy 1, so it lives in an environment of its own: 350 MB to fetch, 970 MB on disk, one to two minutes.
$(VENV)/.programs: $(VENV)/.dev
	npm install --silent --no-fund --no-audit --prefix $(VENV) gltf-validator@2.0.0-dev.3.10 \
	    || echo "no gltf-validator: its test skips"
	rm -rf $(VENV)/blender
	$(PYTHON) -m venv $(VENV)/blender && $(VENV)/blender/bin/python -m pip install --quiet "bpy>=4.2" \
	    || { rm -rf $(VENV)/blender; echo "no bpy for this Python: tests with Blender skip"; }
	touch $@

demo: $(VENV)/.run
	$(BIN)/video2anim demo --out demo_out

# Two workers, a file at a time; each has one thread for its numbers. Types are checked meanwhile and shown at the end.
test: $(VENV)/.programs
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python > $(VENV)/pyright.log & types=$$!; \
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder --durations=20; tests=$$?; \
	wait $$types; typed=$$?; cat $(VENV)/pyright.log; exit $$((tests || typed))

# Units and laws, without what takes longer than a moment (tests/slow_tests.txt).
fast: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder --fast

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev
	$(BIN)/pyright --pythonpath $(BIN)/python

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
