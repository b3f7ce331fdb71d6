# Two commands do everything: `make demo` and `make test`; both set up first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test test-slow lint figures docs bench clean
.DEFAULT_GOAL := demo

demo: $(STAMP)
	$(BIN)/scan2albedo demo -o demo_out

# Two workers, for most tests are single-threaded; an idle one takes over tests of the other. BLAS keeps to
# one thread in each: with two, they wait for the other worker's, and a small fit takes six times as long.
PYTEST := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal

test: $(STAMP)
	$(PYTEST) -m "not slow"

test-slow: $(STAMP)
	$(PYTEST) -m slow

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache --no-logo
	$(BIN)/python tools/house.py
	$(BIN)/python tools/figures.py --check

# What can be counted, and what was recorded, into README and docs/.
figures: $(STAMP)
	$(BIN)/python tools/figures.py

# Strict: a link that leads nowhere ends it. NO_MKDOCS_2_WARNING silences an advertisement of the theme.
docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

bench: $(STAMP)
	$(BIN)/python tools/bench pipeline/stages

$(STAMP): pyproject.toml constraints.txt tools/bootstrap_system.sh
	PYTHON=$(PYTHON) tools/bootstrap_system.sh
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[test,dev]"
	$(BIN)/scan2albedo doctor --warm
	touch $(STAMP)

clean:
	rm -rf $(VENV) demo_out site build *.egg-info
