# The commands of the project; `make help` lists them.  Everything runs in .venv, which the first one makes.

VENV ?= .venv
BIN := $(VENV)/bin
export PYTHON
# Tests start hundreds of processes; without its bytecode on disk each would compile what it imports, a service for 0.3 s.
unexport PYTHONDONTWRITEBYTECODE

SETUP := deploy/setup/environment.sh deploy/setup/system.sh deploy/setup/browser.sh deploy/setup/cholmod.sh
# Stamps: what is installed follows from pyproject.toml and the set-up scripts; only their change runs pip again.
READY := $(VENV)/.ready
READY_DEV := $(VENV)/.ready-dev

.DEFAULT_GOAL := help
.PHONY: help pictures docs setup demo live test test-data test-kernels plain-kernels checked-kernels stock-kernels test-faults lint check crash bench wheel release clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(READY_DEV) ## virtual environment, the project with all its extras; CHOLMOD where it can be compiled

$(READY): pyproject.toml $(SETUP)
	@bash deploy/setup/environment.sh $(VENV) service,viz,gateway,ros2
	@touch $@

# bench: other libraries to compare with, which the tests have as oracles.
$(READY_DEV): pyproject.toml $(SETUP)
	@bash deploy/setup/environment.sh $(VENV) service,metis,viz,watch,record,gateway,ros2,dev,bench,docs
	@touch $(READY) $@

demo: $(READY) ## a simulated robot drives: solver, workers, robot and viewer as processes on the bus
	@$(BIN)/factorbus demo $(ARGS)

live: $(READY) ## a graph file of yours, FILE=my.g2o, as a live map in the browser
	@$(BIN)/factorbus replay $(if $(FILE),"$(FILE:~/%=$(HOME)/%)") --live $(ARGS)

# Side by side, the tests of one file in one process, which share what it has started, the longest files first; then, one by one, those that want
# the machine to themselves.  `tests/test_side_by_side.py` holds that each runs in one of the two.
test: $(READY_DEV) ## the tests
	@$(BIN)/factorbus warm
ifeq ($(strip $(ARGS)),)
	$(BIN)/python -m pytest -m "not data and not alone" -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder
	$(BIN)/python -m pytest -m "not data and alone"
else
	$(BIN)/python -m pytest -m "not data" $(ARGS)
endif

test-data: $(READY_DEV) ## the long tests on the public data sets (FACTORBUS_DATASETS)
	@$(BIN)/factorbus warm
	$(BIN)/python -m pytest -m data $(ARGS)

# Compiled code neither checks an index nor counts as covered.  Each way has kernels of its own in the cache.
KERNEL_TESTS := tests/solver/test_factor_kinds.py tests/solver/test_cholesky_kernels.py tests/solver/test_few.py \
	tests/solver/test_observations.py tests/workers/test_idp_lenses.py tests/workers/test_idp_features.py
# A kernel that counts from the end of an array without saying so would read what is before it.  They need two thirds of all kernels.
CHECKED_TESTS := tests/solver/test_solver_steps.py tests/solver/test_tree.py tests/solver/test_covariance.py \
	tests/solver/test_joined.py tests/solver/test_worker_threads.py tests/solver/test_columns.py tests/solver/test_renew.py \
	tests/solver/test_room.py tests/solver/test_decrement.py
# Numba as it is, without what we change in it.
STOCK_TESTS := tests/solver/test_jit.py tests/solver/test_jit_arrays.py tests/solver/test_cholesky_kernels.py tests/solver/test_factor_kinds.py
# Three ways, side by side: each has kernels of its own to compile, on one core.
test-kernels: $(READY_DEV) ## the kernels again: as plain Python, with every index checked, and by Numba as it is
	@$(MAKE) --no-print-directory --jobs 2 --output-sync=target stock-kernels checked-kernels plain-kernels

plain-kernels:
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest $(KERNEL_TESTS) $(ARGS)

checked-kernels:
	NUMBA_BOUNDSCHECK=1 $(BIN)/python -m pytest $(KERNEL_TESTS) $(CHECKED_TESTS) $(ARGS)

stock-kernels:
	FACTORBUS_STOCK_NUMBA=1 $(BIN)/python -m pytest $(STOCK_TESTS) $(ARGS)

test-faults: $(READY_DEV) ## workers killed and frozen in mid-job, 400 times
	@$(BIN)/factorbus warm
	FACTORBUS_FAULTS=400 $(BIN)/python -m pytest -s --timeout 3600 tests/system/test_features_faults.py $(ARGS)

lint: $(READY_DEV) ## ruff, pyright, import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

check: lint test ## lint and test: what CI runs

crash: $(READY_DEV) ## a service with a journal is killed 150 times; nothing answered may be lost, nothing be there twice
	@$(BIN)/factorbus warm
	FACTORBUS_KILLS=$(or $(KILLS),110) $(BIN)/python -m pytest -s tests/system/test_journal_crash.py $(ARGS)

bench: $(READY_DEV) ## the measurements, each with what it is held against
	@$(BIN)/factorbus bench all $(ARGS)

docs: $(READY_DEV) ## build the site into out/docs, and check every link in it
	@$(BIN)/python docs/machinery/build.py out/docs

pictures: $(READY_DEV) ## draw the pictures of the README and the site again
	@$(BIN)/factorbus simulate manhattan --poses 1500 --seed 7 --out $(BIN)/../town.jrl
	@$(BIN)/factorbus plot map $(BIN)/../town.jrl --solve --out docs/town.png
	@$(BIN)/factorbus simulate manhattan --poses 800 --seed 7 --out $(BIN)/../town.g2o
	@$(BIN)/factorbus plot map $(BIN)/../town.g2o --solve --ellipses 40 --out docs/figures/town-map.png
	@for what in sparsity tree drive; do $(BIN)/factorbus plot $$what $(BIN)/../town.g2o --out docs/figures/town-$$what.png; done
	@bash docs/notebooks/pictures.sh $(BIN)
	@$(BIN)/factorbus demo monocular --frames 120 --points 200 --plot docs/figures/rays.png

wheel: $(READY_DEV) ## build the wheel and try it in a clean virtual environment
	@bash deploy/setup/try-wheel.sh $(BIN)/python

release: $(READY_DEV) ## build and check what is uploaded, into dist; ARGS=--rehearse: of any commit, without a tag
	@bash deploy/release/release.sh $(BIN)/python dist $(ARGS)

clean: ## remove what is built, not .venv
	rm -rf dist build out .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
