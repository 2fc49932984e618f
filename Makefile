PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
DOCS := $(VENV)/.docs-installed
SITE := docs/_build/html

.PHONY: demo test check docs docs-serve clean

demo: $(INSTALLED)  ## Run the main job and show its result.
	$(BIN)/sbi-active run numerical --method asbi --rounds 4 --seed 0 --out demo

test: $(INSTALLED)  ## Run the default tests, one thread for each worker.
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal --durations=25

check: $(INSTALLED)  ## Lint and types.
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

docs: $(DOCS)  ## Build the site, without network, and check its links and names.
	$(BIN)/python -m sphinx -b html -W --keep-going docs $(SITE)
	$(BIN)/python docs/_ext/check_site.py $(SITE)
	$(BIN)/python -m pytest -q -n0 tests/docs/test_reference_examples.py

docs-serve: docs  ## Show the site at http://localhost:8000.
	$(BIN)/python -m http.server --directory $(SITE) --bind 127.0.0.1 8000

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

$(DOCS): $(INSTALLED)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[docs]"
	touch $@

clean:
	rm -rf $(VENV) demo build dist docs/_build docs/reference/api
