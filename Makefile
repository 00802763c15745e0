# The commands of the project; `make help` lists them.  Everything runs in .venv, which the first one makes.

VENV ?= .venv
BIN := $(VENV)/bin
export PYTHON

SETUP := deploy/setup/environment.sh deploy/setup/system.sh
# Stamps: what is installed follows from pyproject.toml and the set-up scripts; only their change runs pip again.
READY := $(VENV)/.ready
READY_DEV := $(VENV)/.ready-dev

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-data test-kernels lint check bench wheel clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(READY_DEV) ## system package, virtual environment, the project with all its extras

$(READY): pyproject.toml $(SETUP)
	@bash deploy/setup/environment.sh $(VENV) service,viz
	@touch $@

# bench: other libraries to compare with, which the tests have as oracles.
$(READY_DEV): pyproject.toml $(SETUP)
	@bash deploy/setup/environment.sh $(VENV) service,viz,dev,bench
	@touch $(READY) $@

demo: $(READY) ## a simulated robot drives: solver, workers, robot and viewer as processes on the bus
	@$(BIN)/factorbus demo $(ARGS)

test: $(READY_DEV) ## the tests
	@$(BIN)/factorbus warm
	$(BIN)/python -m pytest -m "not data" $(ARGS)

test-data: $(READY_DEV) ## the long tests on the public data sets (FACTORBUS_DATASETS)
	@$(BIN)/factorbus warm
	$(BIN)/python -m pytest -m data $(ARGS)

# Compiled code neither checks an index nor counts as covered.  Each way has kernels of its own in the cache.
KERNEL_TESTS := tests/solver/test_factor_kinds.py tests/solver/test_cholesky_kernels.py \
	tests/workers/test_idp_lenses.py tests/workers/test_idp_features.py tests/workers/test_idp_factors.py
test-kernels: $(READY_DEV) ## the kernels again: as plain Python, and with every index checked
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest $(KERNEL_TESTS) $(ARGS)
	@NUMBA_BOUNDSCHECK=1 $(BIN)/factorbus warm
	NUMBA_BOUNDSCHECK=1 $(BIN)/python -m pytest $(KERNEL_TESTS) tests/solver/test_solver_steps.py $(ARGS)

lint: $(READY_DEV) ## ruff, pyright, import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

check: lint test ## lint and test: what CI runs

bench: $(READY_DEV) ## the measurements, each with what it is held against
	@$(BIN)/factorbus bench all $(ARGS)

wheel: $(READY_DEV) ## build the wheel and try it in a clean virtual environment
	@bash deploy/setup/try-wheel.sh $(BIN)/python

clean: ## remove what is built, not .venv
	rm -rf dist build out .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
