# `make demo` and `make test` need nothing but Python 3.11 or newer with its venv module.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := runs/quickstart
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
INSTALL := $(PIP) install -c constraints.txt --build-constraint constraints.txt -e .

.PHONY: demo test test-all bench calibrate peers check
.DELETE_ON_ERROR:

# Status 3, "not converged within its budget", is an honest end of a demonstration.
demo: $(VENV)/.installed
	@rm -rf $(DEMO)
	@$(BIN)/bayesreg run configs/quickstart.yaml -o $(DEMO) || test $$? -eq 3
	@echo "The report is $(CURDIR)/$(DEMO)/report.html"

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest

# Those that `make test` leaves out for their time, too: the examples of the docs, word for word.
test-all: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m ''

# The table and figure of the docs; a part of it, say make bench ARGS="-k '0.8k'", leaves its own under runs/.
# Types are not checked: that would be timed, too, and lowering a program passes what is of none.
BENCH := $(if $(ARGS),runs/benchmarks.json,docs/benchmarks.json)
bench: $(VENV)/.installed-dev
	@mkdir -p $(dir $(BENCH))
	@JAXTYPING_DISABLE=1 $(BIN)/python -m pytest studies/benchmarks -o python_files='bench_*.py' -o python_functions='bench_*' -n 0 -s \
	--benchmark-columns=median,iqr,rounds --benchmark-sort=fullname --benchmark-json=$(BENCH) $(ARGS); status=$$?; \
	$(BIN)/python -m studies.benchmarks.table $(BENCH) && exit $$status

# Simulation-based calibration and Geweke's test. Threads of a linear algebra library only hinder such small matrices.
calibrate: $(VENV)/.installed-dev
	OPENBLAS_NUM_THREADS=1 JAX_COMPILATION_CACHE_DIR=.jax_cache $(BIN)/python -m studies.calibration -o runs/calibration

# Beside Demons, B-splines and SyN, on pairs with a known truth; on others, say make peers ARGS="sag:14:0.2".
# It needs the two images of the paper's experiment in the folder that BAYESREG_DATA names.
peers: $(VENV)/.installed-peers
	$(BIN)/python -m studies.external $(ARGS)

# Style, imports and types of the source, in a minute.
check: $(VENV)/.installed-dev
	$(BIN)/python -m pytest tests/test_habits.py -n 0 -m ''

$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) install -c constraints.txt --upgrade pip
	$(INSTALL)
	@touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) install -c constraints.txt --upgrade pip
	$(INSTALL) --group dev
	@touch $(VENV)/.installed $@

$(VENV)/.installed-peers: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) install -c constraints.txt --upgrade pip
	$(INSTALL) --group peers
	@touch $(VENV)/.installed $@

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	{ echo "bayesreg needs Python 3.11 or newer; name another one: make PYTHON=/path/to/python"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' || \
	{ echo "This Python cannot make environments; on Debian: apt install python3-venv"; exit 1; }
	$(PYTHON) -m venv $(VENV)
