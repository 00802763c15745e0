# The commands of the project; `make help` lists them.  Everything runs in .venv, which the first one makes.

VENV ?= .venv
BIN := $(VENV)/bin
export PYTHON

SETUP := deploy/setup/environment.sh deploy/setup/system.sh
# Stamps: what is installed follows from pyproject.toml and the set-up scripts; only their change runs pip again.
READY := $(VENV)/.ready
READY_BENCH := $(VENV)/.ready-bench

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-data lint check bench wheel clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(READY) ## system package, virtual environment, the project with its extras

$(READY): pyproject.toml $(SETUP)
	@bash deploy/setup/environment.sh $(VENV) service,viz,dev
	@touch $@

$(READY_BENCH): $(READY)
	@bash deploy/setup/environment.sh $(VENV) service,viz,dev,bench
	@touch $@

demo: $(READY) ## a simulated robot drives: solver, workers, robot and viewer as processes on the bus
	@$(BIN)/factorbus demo $(ARGS)

test: $(READY) ## the tests
	@$(BIN)/factorbus warm
	$(BIN)/python -m pytest -m "not data" $(ARGS)

test-data: $(READY) ## the long tests on the public data sets (FACTORBUS_DATASETS)
	@$(BIN)/factorbus warm
	$(BIN)/python -m pytest -m data $(ARGS)

lint: $(READY) ## ruff, pyright, import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

check: lint test ## lint and test: what CI runs

bench: $(READY_BENCH) ## the measurements, each with what it is held against
	@$(BIN)/factorbus bench all $(ARGS)

wheel: $(READY) ## build the wheel and try it in a clean virtual environment
	@bash deploy/setup/try-wheel.sh $(BIN)/python

clean: ## remove what is built, not .venv
	rm -rf dist build out .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
