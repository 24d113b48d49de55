# Two commands do everything on a machine with Python >= 3.11: `make benchmark` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SOURCES := filtergym filters envs evaluation baselines agents tests benchmarks

.PHONY: benchmark test coverage check format docs clean

benchmark: $(VENV)/.core  ## run every environment with its policies (quick)
	$(BIN)/filtergym benchmark

test: $(VENV)/.dev  ## run the whole test suite
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2

coverage: $(VENV)/.dev  ## the same, and show the lines that no test reaches
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --cov --cov-report=term

check: $(VENV)/.dev  ## format, lint and types
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/python -m pip install --quiet --no-deps --force-reinstall --target $(VENV)/typed .
	MYPYPATH=$(VENV)/typed $(BIN)/mypy -p filtergym
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

docs: $(VENV)/.dev  ## build the documentation into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

format: $(VENV)/.dev  ## put the code into its form
	$(BIN)/ruff format $(SOURCES)
	$(BIN)/ruff check --fix $(SOURCES)

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.core: $(VENV)/bin/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

$(VENV)/.dev: $(VENV)/bin/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --constraint constraints.txt "torch==2.13.0"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[agents,dev]"
	touch $@ $(VENV)/.core

clean:  ## remove everything that make made
	rm -rf $(VENV) build *.egg-info
