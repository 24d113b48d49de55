# Two commands do everything on a machine with Python >= 3.11: `make benchmark` and `make test`.
# Compiled Python files serve the other processes and the next run.
unexport PYTHONDONTWRITEBYTECODE
PYTHON ?= python3
# Processes of `make benchmark`; each takes up to half a GB.
JOBS ?= 2
# Of each reader of `make fuzz`.
FUZZ_SECONDS ?= 600
VENV := .venv
BIN := $(VENV)/bin
SOURCES := docs/conf.py docs/make filtergym compiler filters envs evaluation baselines agents tests benchmarks
WORDS := compiler filters envs evaluation baselines agents filtergym benchmarks docs papers tests README.md CHANGELOG.md CONTRIBUTING.md SECURITY.md RELEASING.md Makefile

# Numbers, and every library once: gymnasium, scipy, pandas, xarray, matplotlib, typer and rich, safetensors, msgspec.
CORE_TESTS := $(addprefix tests/, test_golden_trajectories.py test_observation.py test_parameters.py \
  test_linear_systems.py test_bounds.py test_files.py test_store.py \
  test_recording.py::test_several_tracks_with_truth_in_one_table test_file_estimates.py::test_what_is_written_costs_what_it_has_cost \
  test_evaluation.py::test_tuning_improves_on_fresh_episodes_and_is_repeatable \
  test_evaluation.py::test_dataset_has_named_axes_and_units \
  test_evaluation.py::test_records_follow_from_the_dataset \
  test_rendering.py::test_frames_are_images_that_change \
  test_agents_policies.py::test_shipped_agents_need_no_torch \
  test_command_line.py::test_help_of_every_command_ends_with_an_example \
  test_command_line.py::test_progress_bar_is_silent_without_a_terminal \
  test_command_line.py::test_list_names_everything \
  test_command_line.py::test_evaluate_writes_tidy_records_and_figures)
# What reads files beside the packages, so that an unpacked source distribution must hold them.
SOURCE_TESTS := $(addprefix tests/, test_readme.py test_docs.py test_imports.py \
  test_example_environment.py test_observation.py test_reproduction.py)
EXTRAS := agents,fast,tensorboard,report,render,flights,logs,ins,adapters,onnx,offline,cluster
# A link that leads nowhere, or a page that no other leads to, is an error.
SITE := $(BIN)/python -m sphinx -E -W --keep-going -q -b html docs site
DISTRIBUTIONS := build/distributions

.PHONY: fuzz benchmark test claims test-slow numbers coverage core-tests core-test-names test-processors test-without-unix test-parts test-lowest test-cluster test-extras test-pythons distributions publishable check format docs clean

benchmark: $(VENV)/.core  ## run every environment with its policies (quick)
	$(BIN)/filtergym benchmark --jobs $(JOBS)

test: $(VENV)/.dev  ## run the tests of code, without tests of whole programs
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow and not claims"

claims: $(VENV)/.dev  ## test the statements on results: tables, rankings, limits, records
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile -m "claims and not slow"

test-slow: $(VENV)/.dev  ## run whole programs: pages, recipes, reproductions, a browser, clusters
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal -m slow

fuzz: $(VENV)/.dev  ## every reader of foreign files, coverage-guided, so many seconds each; for the night
	$(BIN)/python -m pip install --quiet --constraint constraints.txt atheris
	for reader in $$($(BIN)/python tests/fuzz_readers.py); do \
	  OMP_NUM_THREADS=1 $(BIN)/python tests/fuzz_readers.py $$reader $(FUZZ_SECONDS) || failed=1; done; exit $${failed:-0}

coverage: $(VENV)/.dev  ## run them all, and show the lines that no test reaches
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile --cov --cov-report=term

core-tests:  # in an environment of its own, build/$(ENVIRONMENT), without torch
	$(PYTHON) -m venv build/$(ENVIRONMENT)
	build/$(ENVIRONMENT)/bin/python -m pip install --quiet --constraint $(VERSIONS) --editable . pytest hypothesis
	OMP_NUM_THREADS=1 build/$(ENVIRONMENT)/bin/python -m pytest $(CORE_TESTS)

core-test-names:
	@echo $(CORE_TESTS)

test-lowest: $(VENV)/.dev  ## core tests with the lowest versions that pyproject.toml declares
	mkdir -p build
	$(BIN)/python tests/check_extras.py --lowest > build/lowest.txt
	$(MAKE) core-tests ENVIRONMENT=lowest VERSIONS=build/lowest.txt

test-cluster: $(VENV)/.dev  ## tests on clusters of Ray and Dask, whose packages change what others import
	$(PYTHON) -m venv build/cluster
	$(BIN)/python -c "import sysconfig; print(f'import site; site.addsitedir({sysconfig.get_path(\"purelib\")!r})')" \
	  > $$(echo build/cluster/lib/python*/site-packages)/beneath.pth
	build/cluster/bin/python -m pip install --quiet --constraint constraints.txt --editable ".[cluster]"
	OMP_NUM_THREADS=1 build/cluster/bin/python -m pytest tests/test_parallel.py -k cluster

test-extras: test-cluster test-lowest  ## each extra alone works, and a sentence names a missing one; lowest versions
	build/cluster/bin/python -m pip install --quiet --constraint constraints.txt --editable ".[$(EXTRAS)]"
	OMP_NUM_THREADS=1 build/cluster/bin/python tests/check_extras.py build/extras
	$(PYTHON) -m venv build/lowest-extras
	echo "import site; site.addsitedir('$$(echo $(CURDIR)/build/lowest/lib/python*/site-packages)')" \
	  > $$(echo build/lowest-extras/lib/python*/site-packages)/beneath.pth
	# Torch stays the tested one: older ones come with all of CUDA.
	ln -sfn $$($(BIN)/python -c "import torch; print(torch.__path__[0])")* build/lowest-extras/lib/python*/site-packages/
	# What a new environment brings is too old to build with, and would be found first.
	build/lowest/bin/python -m pip uninstall --quiet --yes setuptools
	build/lowest-extras/bin/python -m pip install --quiet --constraint build/lowest.txt --editable ".[$(EXTRAS)]"
	OMP_NUM_THREADS=1 build/lowest-extras/bin/python tests/check_extras.py --present build/extras-lowest

test-pythons:  ## core tests with every newer Python that is found
	@for version in 3.12 3.13 3.14; do \
	  if python$$version -c "" 2> /dev/null; then \
	    $(MAKE) core-tests PYTHON=python$$version ENVIRONMENT=python$$version VERSIONS=constraints.txt || exit 1; \
	  else echo "Python $$version is not here: its core tests are skipped."; fi; \
	done

test-processors: $(VENV)/.dev  ## parity, gradients and stored trajectories as other processors compute them
	OMP_NUM_THREADS=1 $(BIN)/python tests/check_processors.py -n 2 --dist worksteal

test-without-unix: $(VENV)/.dev  ## core tests as on Windows, without functions of Unix only
	OMP_NUM_THREADS=1 PYTHONPATH=tests $(BIN)/python -m pytest -p without_unix $(CORE_TESTS)

test-parts: $(VENV)/.dev  ## delete each part beyond the core, one at a time, and run the rest; ten minutes
	OMP_NUM_THREADS=1 PYTHONPATH=tests $(BIN)/python tests/check_parts.py

distributions: $(VENV)/.dev  ## build the distributions; test the wheel and the unpacked source
	rm -rf $(DISTRIBUTIONS)
	$(BIN)/python -m build --outdir $(DISTRIBUTIONS) . > /dev/null
	$(PYTHON) -m venv $(DISTRIBUTIONS)/venv
	cd $(DISTRIBUTIONS) && venv/bin/python -m pip install --quiet --constraint ../../constraints.txt *.whl
	cd $(DISTRIBUTIONS) && OMP_NUM_THREADS=1 venv/bin/python ../../tests/check_distributions.py *.tar.gz *.whl
	cd $(DISTRIBUTIONS) && mkdir source && tar -xzf *.tar.gz --strip-components 1 -C source
	cd $(DISTRIBUTIONS)/source && ../venv/bin/python -m pip install --quiet --constraint constraints.txt \
	  --editable . pytest hypothesis && OMP_NUM_THREADS=1 ../venv/bin/python -m pytest $(SOURCE_TESTS)

publishable: $(VENV)/.dev  ## check with the field's own tools packages, workflows, licences and types; needs an index
	$(BIN)/python tests/check_publishable.py build/publishable

check: $(VENV)/.dev  ## format, lint and types
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/codespell $(WORDS)
	$(BIN)/mypy -p filtergym
	MYPYPATH=docs/make $(BIN)/mypy docs/make
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(SITE)

docs: $(VENV)/.dev  ## build the documentation into site/
	$(SITE)

numbers: $(VENV)/.dev  ## tune, train and ship again, and make every published table; hours, resumes after an interruption
	$(MAKE) -f docs/make/numbers.mk JOBS=$(JOBS)

format: $(VENV)/.dev  ## format the code
	$(BIN)/ruff format $(SOURCES)
	$(BIN)/ruff check --fix $(SOURCES)

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.core: $(VENV)/bin/python pyproject.toml constraints.txt
	# Most modules of these packages are never imported: Python compiles the others when they are, and keeps them.
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable ".[fast,report]"
	touch $@

$(VENV)/.dev: $(VENV)/bin/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --constraint constraints.txt "torch==2.13.0"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[fast,report,agents,dev]"
	touch $@ $(VENV)/.core

clean:  ## remove everything made by make
	rm -rf $(VENV) build site jupyter_execute *.egg-info
