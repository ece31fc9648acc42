PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= results
SEED ?= 0
# Processes of the tests: one for each core, at most four.
TESTS := -q -n auto --maxprocesses 4 --dist worksteal
# More threads than cores make torch many times slower; the processes share the cores.
export OMP_NUM_THREADS ?= 1

.PHONY: paper test quick portable everything view-test bench examine coverage check docs clean dist oldest native claims-quick gpu

paper: $(VENV)/.native
	$(BIN)/python examples/paper --out $(OUT)

test: $(VENV)/.native
	$(BIN)/python -m pytest $(TESTS)

quick: $(VENV)/.native
	$(BIN)/python -m pytest tests $(TESTS) -m "not slow"

# The quick tests with other arithmetic, as on other processors: eight runs. SEED=1 and 2 draw others.
portable: $(VENV)/.native
	$(BIN)/python tests/portable.py --seed $(SEED)

# Every test, with what `make test` may lack: peers, and Chromium and Octave of the system. A test
# that is skipped fails, except for what tests/conftest.py names. The browser's tests watch a clock.
everything: export HYBRIDKIN_MUST_RUN := 1
everything: $(VENV)/.bench $(VENV)/.browser $(VENV)/.native
	$(BIN)/python -m pytest $(TESTS) -m "not browser"
	$(BIN)/python -m pytest -q tests/app/viewer -m browser

# The live view in a real browser; needs Chromium of the system. PICTURES=docs/images also writes the
# pictures of docs/view.md anew, that of the recording with HYBRIDKIN_DATA.
view-test: export HYBRIDKIN_PICTURES := $(PICTURES)
view-test: $(VENV)/.browser $(VENV)/.native
	$(BIN)/python -m pytest -q tests/app/viewer -m browser

bench: $(VENV)/.bench $(VENV)/.native
	$(BIN)/python -m pytest -q tests/benchmarks --benchmark-enable --benchmark-quiet

# The published figures that take under a minute each, beside the committed ones.
claims-quick: $(VENV)/.native
	$(BIN)/python examples/studies/claims.py

# Models on a GPU: whether they agree with the CPU, speed and memory. The CPU uses all its cores.
gpu: $(VENV)/.native
	env -u OMP_NUM_THREADS $(BIN)/python examples/studies/gpu.py --out $(OUT)/gpu

# A shortened examination; docs/reference/reliability_report.md has the figures of the full one.
examine: $(VENV)/.examine $(VENV)/.native
	$(BIN)/python tests/examination --out $(OUT)/examination

coverage: $(VENV)/.examine $(VENV)/.native
	$(BIN)/python -m pytest $(TESTS) --cov --cov-report html:$(OUT)/coverage \
		--cov-report json:$(OUT)/coverage.json --cov-report term

check: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

native: $(VENV)/.native

dist: $(VENV)/.wheels
	PYTHON=$(abspath $(BIN)/python) .ci/wheels
	$(BIN)/python -m twine check --strict dist/*

oldest:
	.ci/oldest

docs: $(VENV)/.docs
	$(BIN)/python -m sphinx -W --keep-going -n -b html docs docs/_build/html

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet torch==2.13.0
	$(BIN)/python -m pip install --quiet --editable ".[full]" --group full
	touch $@

# Compiles what has changed since the installation. Without a C compiler torch computes everything.
$(VENV)/.native: $(VENV)/.installed hatch_build.py hybridkin/_core/kernel_numbers.py \
		$(wildcard hybridkin/native/src/*.[ch])
	-$(BIN)/python hatch_build.py
	touch $@

$(VENV)/.wheels: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --group wheels
	touch $@

$(VENV)/.bench: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --group bench
	touch $@

$(VENV)/.examine: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --group examine
	touch $@

$(VENV)/.browser: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --group browser
	touch $@

$(VENV)/.docs: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --group docs
	touch $@

clean:
	rm -rf $(VENV) $(OUT) build dist hybridkin/native/lib
