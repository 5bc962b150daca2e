# make demo   noisy slopes to surfaces: pictures, a page, meshes and a table in demo/
# make test   the tests, but for the slow ones
# make check  everything that CI runs: the slow tests too, lint, types, notebooks, a short run of the benchmarks
#
# Each makes .venv if it is missing and installs what it needs. To choose where and what:
#   PYTHON=python3.12   the interpreter that makes .venv
#   TORCH=torch         another PyTorch; '' leaves the choice to pip
#   TORCH_INDEX=URL     an index to look into besides the usual one, such as
#                       https://download.pytorch.org/whl/cpu for the small build without CUDA

PYTHON ?= python3
VENV ?= .venv
TORCH ?= torch==2.13.0
TORCH_INDEX ?=
JOBS ?= 2
DEMO ?= demo
PYTEST_ARGS ?=

# Threads that wait sleep: two processes on two cores spin each other to a crawl otherwise.
export OMP_WAIT_POLICY := PASSIVE

BIN := $(VENV)/bin
PIP_INSTALL := $(BIN)/python -m pip install --quiet $(addprefix --extra-index-url ,$(TORCH_INDEX)) $(TORCH)
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS)
SCRATCH := build
CASES ?= 20000
SEED ?= 0

# Benchmarks are pytest files (bench_*.py) and scripts that take --smoke, run as modules; common/ holds their helpers.
BENCH_TESTS := $(wildcard benchmarks/speed/bench_*.py)
BENCH_SCRIPTS := $(filter-out $(BENCH_TESTS),$(wildcard benchmarks/speed/*.py benchmarks/quality/*.py))
SMOKE_SIZES := not 512 and not 1024 and not 2048 and not 64-64
NOTEBOOKS := $(patsubst notebooks/%.py,%,$(wildcard notebooks/*.py))

.PHONY: help demo test test-slow fuzz docs lint format types notebooks notebooks-update picture pictures bench-smoke check check-rest clean
.DELETE_ON_ERROR:

help:
	@sed -n '/^#/!q;s/^# \{0,1\}//p' $(MAKEFILE_LIST)

demo: $(VENV)/.demo
	$(BIN)/torchdls demo --out $(DEMO)

test: $(VENV)/.dev
	$(PYTEST) -m "not slow" $(PYTEST_ARGS)

test-slow: $(VENV)/.dev
	$(PYTEST) -m slow $(PYTEST_ARGS)

fuzz: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.fuzz --cases $(CASES) --seed $(SEED)

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: $(VENV)/.dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: $(VENV)/.dev
	$(BIN)/mypy

# Runs every notebook from its source, into a scratch folder; a cell that fails stops it.
notebooks: $(VENV)/.dev
	@mkdir -p $(SCRATCH)/notebooks
	@set -e; for name in $(NOTEBOOKS); do echo "notebook $$name"; \
	$(BIN)/jupytext --quiet --to ipynb --output $(SCRATCH)/notebooks/$$name.ipynb notebooks/$$name.py; \
	$(BIN)/jupyter nbconvert --log-level=ERROR --to notebook --execute --inplace \
	--ExecutePreprocessor.record_timing=False $(SCRATCH)/notebooks/$$name.ipynb; done

# Runs them and keeps the result beside the source.
notebooks-update: notebooks
	@for name in $(NOTEBOOKS); do cp $(SCRATCH)/notebooks/$$name.ipynb notebooks/$$name.ipynb; done

# The README's picture, from the demo's.
picture: demo
	$(BIN)/python -c "from PIL import Image; p = Image.open('$(DEMO)/terrain.png').convert('RGB'); \
	p.resize((900, p.height * 900 // p.width), Image.Resampling.LANCZOS).quantize(256).save('docs/demo.png', optimize=True)"

# The pictures of the guide, into docs/pictures.
pictures: $(VENV)/.dev
	$(BIN)/python -m docs.pictures

# The site, into build/site; a broken link or name stops it.
docs: $(VENV)/.dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

bench-smoke: $(VENV)/.dev
	$(if $(BENCH_TESTS),$(BIN)/python -m pytest --benchmark-disable --quiet -k "$(SMOKE_SIZES)" $(BENCH_TESTS))
	@set -e; for module in $(subst /,.,$(BENCH_SCRIPTS:.py=)); do echo "$$module --smoke"; \
	$(BIN)/python -m $$module --smoke; done

check: test check-rest

check-rest: test-slow lint types docs
	OMP_NUM_THREADS=1 $(MAKE) --jobs=2 notebooks bench-smoke

clean:
	rm -rf $(SCRATCH) $(DEMO) .mypy_cache .pytest_cache .ruff_cache

$(VENV)/.demo: EXTRAS := plots,files
$(VENV)/.dev: EXTRAS := dev
$(VENV)/.demo $(VENV)/.dev: pyproject.toml
	@echo "Installing torchdls[$(EXTRAS)] into $(VENV): a minute or more"
	@$(PYTHON) -m venv $(VENV)
	$(PIP_INSTALL) --editable ".[$(EXTRAS)]"
	@touch $@
