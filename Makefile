PYTHON ?= python3.11
RUN ?= runs/best
VENV := .venv
BIN := $(VENV)/bin

.DEFAULT_GOAL := help
.PHONY: help install demo test test-all coverage serve lint lock docs bench train network clean

help: ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/'

PIP_INSTALL := $(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt

$(VENV)/runtime: pyproject.toml constraints.txt
	@echo "heliotwin and its guide are installed into $(VENV): about 2 minutes, 1.6 GB"
	$(PYTHON) -m venv $(VENV)
	$(PIP_INSTALL) -e .
	touch $@

$(VENV)/installed: $(VENV)/runtime
	@echo "what tests, linters and training need is installed into $(VENV): about 1 minute, 0.9 GB"
	$(PIP_INSTALL) -e '.[dev]'
	touch $@

install: $(VENV)/installed ## the virtual environment with everything in it; demo and serve need less

demo: $(VENV)/runtime ## photographs in, mirror surfaces and flux forecasts out, under out/demo
	$(BIN)/heliotwin demo $(ARGS)

# Compiled modules are kept, whatever the environment says: without them each process compiles them again.
test test-all coverage: export PYTHONDONTWRITEBYTECODE =

test: install ## what a change needs: units, routes, pages, one task of each user, on SQLite (5 minutes)
	$(BIN)/pytest -n 2 --dist loadgroup -m "not full" $(ARGS)

test-all: install ## every test: also PostgreSQL, faults, browsers, images, notebooks (25 minutes)
	$(BIN)/pytest -n 3 --dist loadgroup $(ARGS)

coverage: install ## lines that make test runs, and in .coverage by which tests; of make test-all: ARGS="-m ''"
	$(BIN)/pytest -n 2 --dist loadgroup -m "not full" --cov --cov-context=test $(ARGS)

lock: install ## the image's packages with their hashes, in the versions of constraints.txt
	PATH=$(BIN):$$PATH $(BIN)/python docker/lock.py $(ARGS)

docs: install ## the guide that the service shows on /docs/guide
	$(BIN)/python -m docs.backend

lint: install ## ruff, mypy, imports between packages, and limits of what makes code hard to read
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m tests.codebase --check

serve: $(VENV)/runtime ## the service on http://127.0.0.1:8000
	$(BIN)/heliotwin serve $(ARGS)

bench: install ## the short benchmarks, into results/, and their figures into RESULTS.md and README
	$(BIN)/python -m benchmarks
	$(BIN)/python -m docs.figures

train: install ## the shipped weights from scratch: network, prior, export, evaluation; resumes what is in RUN
	$(BIN)/python -m training.train --config training/configs/best.json --run $(RUN)
	$(BIN)/python -m training.prior --run $(RUN)
	$(BIN)/python -m training.export --run $(RUN)
	$(BIN)/python -m training.evaluate

network: install ## the network of a heliostat type: make network PLANT=plant.yaml TYPE=standard
	$(BIN)/python -m heliotwin.networks $(PLANT) --type $(TYPE) $(ARGS)

clean: ## remove the virtual environment and everything that was made
	rm -rf $(VENV) out build service/web/root/guide *.egg-info
