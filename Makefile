# Two commands do everything: `make demo` and `make test`; both set up first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test test-quick lint bench clean
.DEFAULT_GOAL := demo

demo: $(STAMP)
	$(BIN)/scan2albedo demo -o demo_out

# All tests. Two workers: the tests are single-threaded for the most part.
test: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist loadfile

test-quick: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow"

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache --no-logo

bench: $(STAMP)
	$(BIN)/python tools/bench_pipeline.py

$(STAMP): pyproject.toml constraints.txt tools/bootstrap_system.sh
	PYTHON=$(PYTHON) tools/bootstrap_system.sh
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[test,dev]"
	touch $(STAMP)

clean:
	rm -rf $(VENV) demo_out build *.egg-info
