# make demo   set up, reconstruct the shipped video, and show what came out
# make test   set up and run the tests (minutes); make test-unit runs the quickest, make test-all the long ones too
VENV ?= .venv
# Test files are spread over two processes; JOBS=0 runs them in one, in order.
JOBS ?= 2
# In the order of tests/conftest.py, long files first: xdist's own order puts files with few tests last.
SPREAD = -n $(JOBS) --dist loadfile --no-loadscope-reorder
PYTHON_IN_VENV = $(VENV)/bin/python

.PHONY: setup demo test test-unit test-all perf lint format build clean

setup:
	@VENV=$(VENV) tools/setup.sh

demo: setup
	@$(PYTHON_IN_VENV) tools/demo.py

test: setup
	$(PYTHON_IN_VENV) -m pytest $(SPREAD)

test-unit: setup
	$(PYTHON_IN_VENV) -m pytest $(SPREAD) -m unit

test-all: setup
	$(PYTHON_IN_VENV) -m pytest $(SPREAD) -m "not gpu"

# Kernels beside those of the commit in benchmarks/perf/base.txt, on this machine.
perf: setup
	$(PYTHON_IN_VENV) -m benchmarks.perf --against base

lint: setup
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/pyright --pythonpath $(PYTHON_IN_VENV)

format: setup
	$(VENV)/bin/ruff format .
	$(VENV)/bin/ruff check --fix .

build: setup
	$(PYTHON_IN_VENV) -m pip wheel --no-deps -w dist .

clean:
	rm -rf build dist .pytest_cache .ruff_cache
