# Two commands do everything: `make study` and `make test`. The rest is listed by `make help`.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
LAB_STAMP := $(VENV)/lab-installed
JOBS ?= 2
RUNS := results/runs
EVIDENCE := results/runs/evidence
export PYTHONHASHSEED := 0
# One arithmetic thread a process: sums then have one order, and two workers do not fight over two cores.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
export MKL_NUM_THREADS := 1
export NUMEXPR_NUM_THREADS := 1

.PHONY: help setup study results evidence test check notebooks reference bench lab lock clean

help:  ## this list
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

setup: $(STAMP)  ## create .venv from environment.lock

$(STAMP): environment.lock pyproject.toml tools/setup.sh tools/check_system.py
	@bash tools/setup.sh $(VENV)
	@touch $@

study: results  ## run the whole study: the notebooks; ends with the finding, the report, the comparison
	$(BIN)/study compare results/reference $(RUNS)

results: $(STAMP)
	$(BIN)/study notebooks --jobs $(JOBS) --out $(RUNS)/notebooks
	$(BIN)/study report --html $(RUNS)

evidence: $(STAMP)  ## robustness, sensitivity, more people: up to 90 minutes on 2 cores, goes on where it was stopped
	$(BIN)/study evidence --out $(EVIDENCE) --jobs $(JOBS)

test: $(STAMP)  ## every test, and the notebooks on the quick profile
	$(BIN)/pytest -n $(JOBS) --dist worksteal

check: $(STAMP)  ## ruff, types, import layers, notebook pairing
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tools/notebooks.py check
	$(BIN)/python tools/claims.py check
	$(BIN)/python tools/readme.py check

notebooks: $(STAMP)  ## execute the notebooks in place, outputs kept
	$(BIN)/python tools/notebooks.py write --jobs $(JOBS)

reference: results  ## run the study, renew results/reference and results/evidence, draft the CHANGELOG rows
	$(BIN)/python tools/reference.py --runs $(RUNS)
	for part in robustness sensitivity people; do if [ -d $(EVIDENCE)/$$part ]; then \
	  mkdir -p results/evidence && rm -rf results/evidence/$$part && cp -r $(EVIDENCE)/$$part results/evidence/$$part; \
	  fi; done
	$(BIN)/study anatomy --dataset open --out results/anatomy.csv
	$(BIN)/python tools/claims.py write
	$(BIN)/python tools/readme.py write

bench: $(STAMP)  ## ratios and rates quoted in the README
	for script in benchmarks/*.py; do echo "== $$script"; $(BIN)/python $$script || exit 1; done

lab: $(LAB_STAMP)  ## open the notebooks in JupyterLab, each paired with its script while it is edited
	$(BIN)/jupyter lab --ServerApp.root_dir=$(CURDIR) --LabApp.default_url=/lab/tree/notebooks/00_data.ipynb

$(LAB_STAMP): $(STAMP) environment-lab.lock
	$(BIN)/python -m pip install -qq --disable-pip-version-check --no-deps --require-hashes -r environment-lab.lock
	@touch $@

lock: $(STAMP)  ## renew environment.lock and environment-lab.lock from pyproject.toml
	bash tools/lock.sh

clean:  ## remove the environment and the runs, keep downloads
	rm -rf $(VENV) $(RUNS) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
