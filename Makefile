# The same commands for people and for CI. `make run` and `make test` install what they need.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
# Three on two cores, because tests of whole services often wait. The tests of a file run in one process, in order, because
# they share servers and browsers. Files start in alphabetical order, so the longest ones, in acceptance, browser and
# integration, come first.
TEST_PROCESSES ?= 3
SIDE_BY_SIDE := --numprocesses $(TEST_PROCESSES) --dist loadfile --no-loadscope-reorder
PAGE_SOURCES := $(shell find frontend/src frontend/public frontend/index.html frontend/package-lock.json frontend/vite.config.ts 2>/dev/null)

# Commands and tests start many Python processes, which load compiled modules in less time.
unexport PYTHONDONTWRITEBYTECODE

CHECKS := check-types check-page check-imports check-style

.PHONY: run test docs test-docs test-slow test-avx2 test-deployment check $(CHECKS) bench screenshots soak learn format system system-test clean football test-loggers test-imitation test-ray

run: $(INSTALLED) ## Start Accord with an example experiment and print a sign-in link
	$(BIN)/accord up --example

test: $(INSTALLED) system-test check ## Format, lint, types, import rules, then the tests, in about ten minutes
	$(BIN)/python -m pytest -m "not benchmark and not learn and not deployment and not slow and not docs" $(SIDE_BY_SIDE)

test-slow: $(INSTALLED) system-test ## The 7% of the tests that take more than half of the time: trainings, whole services, most of the browser; part of CI
	$(BIN)/python -m pytest --quiet -m slow $(SIDE_BY_SIDE)

test-avx2: $(INSTALLED) ## The tests of computed numbers again, with AVX2, so that none depends on one processor's rounding; part of CI
	ATEN_CPU_CAPABILITY=avx2 ONEDNN_MAX_CPU_ISA=AVX2 $(BIN)/python -m pytest --quiet -m numerics $(SIDE_BY_SIDE) tests/unit

test-deployment: $(INSTALLED) ## The steps of the Dockerfile in a chroot, and the service in it; minutes, as root; part of CI
	@.ci/system-packages deployment
	$(BIN)/python -m pytest -m deployment tests/deployment

docs: $(INSTALLED) ## Build the documentation into build/site; warnings are errors
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev,docs]"
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --config-file docs/site/mkdocs.yml

test-docs: docs system-test ## Build the documentation, and run the code in it; part of CI
	$(BIN)/python -m pytest --quiet -m docs $(SIDE_BY_SIDE) tests/docs

check: $(INSTALLED) ## Format, lint, types, import rules, the page; the longest first, two at a time
	@$(MAKE) --no-print-directory --jobs 2 --output-sync=target $(CHECKS)

check-types:
	$(BIN)/pyright

check-page:
	cd frontend && PATH="$(abspath $(BIN)):$$PATH" npm run --silent check

check-imports:
	$(BIN)/lint-imports --no-logo

check-style:
	$(BIN)/ruff format --check backend models tests frontend docs
	$(BIN)/ruff check backend models tests frontend docs

format: $(INSTALLED) ## Format Python and TypeScript in place
	$(BIN)/ruff format backend models tests frontend docs
	$(BIN)/ruff check --fix backend models tests frontend docs
	cd frontend && PATH="$(abspath $(BIN)):$$PATH" npm run --silent format

bench: $(INSTALLED) ## Every benchmark, with its upper bound in the same run
	$(BIN)/python tests/benchmarks

screenshots: $(INSTALLED) system-test ## Photograph every page of a real service into docs/images/pages, and write docs/pages.md
	$(BIN)/python docs/screenshots.py

ROUNDS ?= 200
soak: $(INSTALLED) system-test ## Kill a random process in ROUNDS rounds under load, on both databases; then memory over 50,000 requests
	$(BIN)/python tests/soak/kills.py --rounds $(ROUNDS) --database sqlite
	$(BIN)/python tests/soak/kills.py --rounds $(ROUNDS) --database postgres
	$(BIN)/python tests/soak/memory.py --database sqlite
	$(BIN)/python tests/soak/memory.py --database postgres

football: $(INSTALLED) ## Install the engine of the football tasks, which takes about ten minutes of CPU time, and run their tests
	@.ci/system-packages football
	$(BIN)/python -c "import gfootball_engine" 2>/dev/null || $(MAKE) --no-print-directory football-engine
	$(BIN)/python -m pytest --quiet tests/unit/tasks/test_football_engine.py

test-loggers: $(INSTALLED) ## Install the extras wandb and mlflow, and a real MLflow server, some 700 MB, and run their tests
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev,wandb,mlflow]"
	test -x $(MLFLOW_SERVER)/bin/mlflow || { $(PYTHON) -m venv $(MLFLOW_SERVER) && $(MLFLOW_SERVER)/bin/pip install --quiet "mlflow==$$($(BIN)/python -c 'import mlflow; print(mlflow.__version__)')"; }
	$(BIN)/python -m pytest --quiet tests/integration/training/test_loggers.py

test-imitation: $(INSTALLED) system-test ## Install imitation, 1.8 GB with another torch, and exchange a dataset with it
	test -x $(IMITATION)/bin/python || $(PYTHON) -m venv $(IMITATION)
	$(IMITATION)/bin/pip install --quiet imitation==1.0.1 "torch==$$($(BIN)/python -c 'import torch; print(torch.__version__)')" "mujoco<4" imageio
	$(BIN)/python -m pytest --quiet tests/browser/test_other_programs.py -k imitation

test-ray: $(INSTALLED) ## Install the extra ray, 277 MB, and run its tests
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev,ray]"
	$(BIN)/python -m pytest --quiet $(RAY_TESTS)

RAY_TESTS := tests/integration/cluster

# imitation needs an older gymnasium than Accord.
IMITATION := $(VENV)/imitation

# The server needs an older pyarrow than Accord.
MLFLOW_SERVER := $(VENV)/mlflow-server

# gfootball and gym need old tools to be built, which have an environment of their own.
FOOTBALL_BUILD := $(VENV)/football-build
.PHONY: football-engine
football-engine:
	$(PYTHON) -m venv $(FOOTBALL_BUILD)
	$(FOOTBALL_BUILD)/bin/pip install --quiet 'setuptools<65' 'wheel<0.40' psutil six
	PATH="$(abspath $(FOOTBALL_BUILD))/bin:$$PATH" pip wheel --no-build-isolation --no-deps --constraint constraints.txt --wheel-dir $(FOOTBALL_BUILD)/wheels gfootball gym
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --find-links $(FOOTBALL_BUILD)/wheels gfootball gym six

learn: $(INSTALLED) ## The long learning runs behind docs/results.md
	$(BIN)/python -m pytest -m learn tests/learning --timeout 0

$(INSTALLED): pyproject.toml constraints.txt frontend/hatch_build.py frontend/build_page.py $(PAGE_SOURCES) | system
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

system: ## Debian packages that pip cannot bring: EGL, venv
	@.ci/system-packages run

system-test: ## Those that only the tests need: a browser, PostgreSQL
	@.ci/system-packages test

clean: ## Delete the environment and the built page
	rm -rf $(VENV) backend/accord/static frontend/node_modules

.PHONY: client
client: $(INSTALLED) ## Write frontend/openapi.json and the TypeScript client from the API
	$(BIN)/python -m accord.api.openapi frontend/openapi.json
	cd frontend && PATH="$(abspath $(BIN)):$$PATH" npm run --silent generate
