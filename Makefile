PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= results
# More threads than cores make torch many times slower; the processes share the cores.
export OMP_NUM_THREADS ?= 1

.PHONY: paper test check clean

paper: $(VENV)/.installed
	$(BIN)/python -m hybridkin paper --out $(OUT)

test: $(VENV)/.installed
	$(BIN)/python -m pytest -q

check: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet torch==2.13.0
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	touch $@

clean:
	rm -rf $(VENV) $(OUT)
