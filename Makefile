# Every target sets up what it needs in the virtual environment $(VENV): the first run installs,
# later runs reuse it until pyproject.toml changes. The one prerequisite is Python >= 3.11 with pip.

PYTHON ?= python3
VENV ?= .venv
WORKERS ?= 2

BIN := $(VENV)/bin
export JAX_PLATFORMS ?= cpu
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Images of containers often forbid Python to keep what it compiled. Then each process compiles all
# of JAX anew, which takes 4 s, and there are a hundred.
export PYTHONDONTWRITEBYTECODE :=

.DEFAULT_GOAL := help
# Two targets would run pip in the same environment.
.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: help demo test lowest newest slow clients coverage shapes soak mutants lint format types docs examples bench bench-smoke bench-learned bench-studies bench-published build clean distclean

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1|\2/p' Makefile | column -t -s '|' 2>/dev/null \
	  || sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1: \2/p' Makefile
	@echo "Another Python than '$(PYTHON)': make TARGET PYTHON=python3.12"

# ---- Set-up: one stamp per optional extra of pyproject.toml ----

$(BIN)/python:
	@command -v "$(PYTHON)" >/dev/null || { \
	  echo "There is no '$(PYTHON)' here. Install Python 3.11 or newer, or name one:" \
	       "make TARGET PYTHON=/path/to/python3" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "diffrax-conserve needs Python 3.11 or newer, but '$(PYTHON)' is" \
	       "$$("$(PYTHON)" --version 2>&1). Name a newer one: make TARGET PYTHON=python3.12" >&2; \
	  exit 1; }
	@echo "Creating the virtual environment $(VENV)"
# Debian's Python has no ensurepip unless python3-venv is installed; there the pip outside installs
# the one inside.
	@"$(PYTHON)" -m venv --clear "$(VENV)" >/dev/null 2>&1 || { \
	  "$(PYTHON)" -m venv --clear --without-pip "$(VENV)" && \
	  "$(PYTHON)" -m pip --python "$(BIN)/python" install --quiet pip; }

# It installs in a quarter of the time of pip.
$(BIN)/uv: | $(BIN)/python
	@$(BIN)/python -m pip install --quiet uv

# pip takes over where only pip knows the way to the packages, by a configuration of its own.
$(VENV)/.installed-%: pyproject.toml | $(BIN)/uv
	@echo "Installing diffrax-conserve[$*] into $(VENV)"
	@$(BIN)/uv pip install --quiet --python $(BIN)/python --editable '.[$*]' || \
	  $(BIN)/python -m pip install --quiet --no-compile --editable '.[$*]'
	@touch $@

PLOTS := $(VENV)/.installed-plots
TEST := $(VENV)/.installed-sparse,test
SLOW := $(VENV)/.installed-gallery,sparse,test
DEV := $(VENV)/.installed-dev
DOCS := $(VENV)/.installed-docs
BENCH := $(VENV)/.installed-bench

# What the tests compile with: see `tests/conftest.py`.
QUICKLY_COMPILED := $(shell cat tests/xla_flags.txt)

# ---- What a newcomer runs ----

demo: $(PLOTS) ## reproduce two of the paper's examples into out/
	$(BIN)/python -m diffrax_conserve reproduce rigid-body --out out/rigid-body
	$(BIN)/python -m diffrax_conserve reproduce kepler --out out/kepler

# Neighbours, which share fixtures and compiled functions, mostly run in one worker.
SHARED := -n $(WORKERS) --dist worksteal

test: $(TEST) ## run the tests, without the slow ones
	$(BIN)/python -m pytest $(SHARED) -m "not slow and not examples"

# ---- What a developer runs ----

# uv can choose the lowest versions that `pyproject.toml` allows; pip cannot.
LOWEST := $(VENV)/lowest
PROMISED := tests/laws/test_projection.py tests/solver/test_conformance.py tests/solver/test_diffrax.py \
  tests/solver/test_learned.py tests/test_check.py tests/test_find.py tests/test_manifold.py \
  tests/training/test_fit.py

lowest: | $(BIN)/uv ## run a part of the tests with the lowest versions of jax, diffrax and the rest
	$(BIN)/uv venv --quiet --clear --python $(BIN)/python $(LOWEST)
	$(BIN)/uv pip install --quiet --python $(LOWEST)/bin/python --resolution lowest-direct --editable '.[test]'
	$(LOWEST)/bin/python -m pytest $(SHARED) -m "not slow and not examples" $(PROMISED)

# The newest Python that is here; those of pyenv are no commands unless they were chosen.
NEWEST_PYTHON ?= $(shell for minor in 16 15 14 13 12 11; do \
  for found in python3.$$minor "$$HOME"/.pyenv/versions/3.$$minor.*/bin/python; do \
  "$$found" -c "" 2>/dev/null && echo "$$found" && exit; done; done; echo "$(PYTHON)")
NEWEST := $(VENV)/newest

# A failure says that a bound is needed, or that the code must change.
newest: | $(BIN)/uv ## run the tests with the newest Python and jax that can be had
	$(BIN)/uv venv --quiet --clear --python "$(NEWEST_PYTHON)" $(NEWEST)
	$(BIN)/uv pip install --quiet --python $(NEWEST)/bin/python --editable '.[sparse,test]'
	@$(NEWEST)/bin/python --version
	@$(BIN)/uv pip freeze --quiet --python $(NEWEST)/bin/python | grep -E '^(diffrax|equinox|jax)='
	$(NEWEST)/bin/python -m pytest $(SHARED) -m "not slow and not examples"

CLIENTS := $(VENV)/clients

clients: | $(BIN)/uv ## run published packages that use diffrax, with one solver exchanged
	$(BIN)/uv venv --quiet --clear --python "$(NEWEST_PYTHON)" $(CLIENTS)
	$(BIN)/uv pip install --quiet --python $(CLIENTS)/bin/python --editable '.[clients,test]'
	$(CLIENTS)/bin/python -m pytest -m slow tests/test_clients.py

slow: export XLA_FLAGS ?=
slow: export EQX_ON_ERROR ?= raise
slow: $(SLOW) ## run the slow tests, with all pages of the docs, and all benchmarks at toy sizes
	$(BIN)/python -m pytest $(SHARED) -m slow
	$(BIN)/python benchmarks/studies/mjx.py
	$(MAKE) bench-smoke SMOKED="$(SMOKABLE)"
	$(MAKE) clients

COVERED ?= tests

coverage: $(TEST) ## which lines the fast tests execute
	$(BIN)/python -m pytest $(SHARED) -m "not slow and not examples" --cov --cov-report=term:skip-covered $(COVERED)

# Some projections, solves, systems and networks.
CHECKED := tests/laws/test_projection.py tests/solver/test_options.py tests/systems/test_paper.py \
  tests/network/test_layer.py tests/solver/test_dae_structure.py tests/solver/test_dae_circuits.py

# Laws that hold to roundoff or bit for bit, which what XLA fuses might break: `make test` compiles
# without its optimisations.
OPTIMISED := \
  tests/laws/test_units.py::test_powers_of_two_as_units_change_nothing \
  tests/laws/test_never_silent.py::test_what_underflows_is_no_success \
  tests/projection/test_laws.py::test_a_lane_of_a_batch_is_that_lane_alone \
  tests/projection/test_linear.py::test_columns_in_other_units_change_no_bit \
  tests/projection/test_linear.py::test_dependent_rows_are_corrected_if_they_are_consistent \
  tests/solver/test_conservation.py::test_drift_is_at_roundoff_where_a_species_almost_dies_out \
  tests/solver/test_diffrax.py::test_a_continued_solve_keeps_the_first_conserved_value_and_refuses_another

# Without a summary line of its own: see `examples`.
shapes: $(TEST) ## run some tests with types and shapes checked, and some as XLA compiles for users
	SHAPES=1 $(BIN)/python -m pytest $(SHARED) -qq -m "not slow and not examples" $(CHECKED)
	XLA_FLAGS= $(BIN)/python -m pytest $(SHARED) -qq -m "not slow and not examples" $(OPTIMISED)

COUNT ?= 10000
SEED ?= 0

soak: $(TEST) ## attack the promises COUNT times, in search of a wrong success
	$(BIN)/python -m tests.soak --count $(COUNT) --seed $(SEED)

mutants: $(TEST) ## plant defects, and see which test finds each: tests/mutants.md
	$(BIN)/python tests/mutants.py

lint: $(DEV) ## check style, formatting and spelling
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell

format: $(DEV) ## fix what `make lint` can fix by itself
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: $(DEV) ## check the types of the package
	$(BIN)/pyright --pythonpath $(BIN)/python

# Not `--quiet`, which also hides the warnings from `--strict`.
docs: $(DOCS) ## build the documentation into site/, and look at it
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	$(BIN)/python docs/browser.py site

# Without a summary line of its own, so that a log of the whole CI run holds one: that of `make test`.
examples: export EQX_ON_ERROR ?= raise
examples: $(TEST) ## execute the code blocks of the README, the first pages and the docstrings
	$(BIN)/python -m pytest $(SHARED) -qq -m "examples and not slow" tests/test_docs.py
	@echo "Every example ran."

COSTS := scaling balance dae stiff large compiler_option
TRAININGS := zoo paper chemistry worth
STUDIES := long_run verdict
PUBLISHED := sundials homproj_paper heyoka_page discrete_gradient julia_energy mechanisms \
  positive_chemistry sympflow pinn_issues

bench: $(BENCH) ## measure cost, precision and scaling; tables and figures of the docs
	set -e; for name in $(COSTS); do $(BIN)/python benchmarks/cost/$$name.py; done
	$(BIN)/python benchmarks/cost/reject.py
	$(BIN)/python benchmarks/cost/report.py --write

bench-learned: $(BENCH) ## train the networks of the paper and of the zoo, and measure them: many hours
	set -e; for name in $(TRAININGS); do $(BIN)/python benchmarks/learned/$$name.py; done

bench-studies: $(TEST) ## measure what options and claims of the pages rest on
	set -e; for name in $(STUDIES); do $(BIN)/python benchmarks/studies/$$name.py; done

# Each writes its result when it is done, and is skipped if that is there: remove it to measure anew.
bench-published: $(BENCH) ## compare with what others published; tables of a page: an hour
	set -e; for name in $(PUBLISHED); do $(BIN)/python benchmarks/published/$$name.py; done
	$(BIN)/python benchmarks/published/tables.py --write

SMOKABLE := $(COSTS:%=cost/%) cost/many_constraints cost/few_constraints $(STUDIES:%=studies/%) learned/chemistry \
  $(PUBLISHED:%=published/%)
SMOKED ?= cost/balance learned/chemistry studies/long_run published/mechanisms

# At toy sizes nearly all of it is compilation, so it is compiled as in the tests, beside the option
# that the pages recommend.
SMALL_LOOPS := xla_cpu_small_while_loop_byte_threshold=65536
comma := ,
bench-smoke: export XLA_FLAGS := $(subst options=,options=$(SMALL_LOOPS)$(comma),$(QUICKLY_COMPILED))
bench-smoke: $(TEST) ## one benchmark of each folder at toy sizes, to see that it runs; all in `make slow`
	printf '%s\n' $(SMOKED) | xargs -P $(WORKERS) -I NAME $(BIN)/python benchmarks/NAME.py --smoke
	$(BIN)/python benchmarks/cost/report.py

# The environment of the check is new and its folder is not this one: only the wheel can be imported.
build: $(DEV) ## build wheel and sdist, then try the wheel in an environment of its own
	rm -rf dist
	$(BIN)/python -m build --installer uv
	$(BIN)/twine check --strict dist/*
	@root=$$PWD; tmp=$$(mktemp -d); trap 'rm -rf "$$tmp"' EXIT; set -e; \
	"$(BIN)/python" -m venv --without-pip "$$tmp/venv"; \
	"$(BIN)/python" -m pip --python "$$tmp/venv/bin/python" install --quiet --no-compile "$$root"/dist/*.whl; \
	cd "$$tmp"; \
	venv/bin/python -c 'import diffrax_conserve as d; print(d.__version__, d.__file__)'; \
	venv/bin/diffrax-conserve --version; venv/bin/python -m diffrax_conserve list

clean: ## remove what the targets wrote, but not the virtual environment
	rm -rf dist site out .pytest_cache .ruff_cache .hypothesis

distclean: clean ## remove the virtual environment too
	rm -rf "$(VENV)"
