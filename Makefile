# `make demo` and `make test` do all their own set-up: a virtual environment in .venv, the package, the model files.
# Outside this folder they only fill pip's cache and the model cache (UNDERSTUDY_CACHE, default ~/.cache/understudy).
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
export MPLCONFIGDIR := $(CURDIR)/.cache/matplotlib
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export TF_CPP_MIN_LOG_LEVEL := 2

# these write pages of docs/, from recordings that not everybody has
PAGES := benchmarks/paper_tables.py benchmarks/palms.py benchmarks/demonstrations.py
.PHONY: demo test check format bench clean help

help:
	@echo "make demo    set up, then estimate the people of a bundled recording, and teach a robot from another (into demo/)"
	@echo "make test    set up, then run the tests"
	@echo "make check   set up, then ruff and mypy"
	@echo "make format  let ruff rewrite the code in its style"
	@echo "make bench   set up, then time the hot paths (benchmarks/)"
	@echo "make clean   remove the virtual environment and everything that was made here"

demo: $(VENV)/user.stamp
	$(BIN)/understudy models fetch
	$(BIN)/understudy estimate sample --out demo
	$(BIN)/understudy compare sample --out demo/compare.png
	$(BIN)/understudy teach sample-drawer --task drawer --robot pr2 --out demo/drawer
	@echo; echo "Made by 'make demo' (look at these):"; ls demo/overlays/*.png; echo demo/people.json; \
	  echo "demo/compare.png: network and naive lifting side by side, on a person whom the desk hides"; \
	  echo "In 3D: $(BIN)/understudy view demo"; \
	  echo "What the robot learnt, and its video: demo/drawer/report.html"

test: $(VENV)/dev.stamp
	$(BIN)/understudy models fetch
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist loadfile

check: $(VENV)/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/dev.stamp
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/dev.stamp
	$(BIN)/understudy models fetch
	for script in $(filter-out $(PAGES),$(wildcard benchmarks/[a-z]*.py)); do $(BIN)/python $$script || exit 1; done

clean:
	rm -rf $(VENV) .cache demo .pytest_cache .mypy_cache .ruff_cache .hypothesis

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is needed; name one: make PYTHON=python3.11 ..."; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/user.stamp: pyproject.toml | $(VENV)/bin/python
	$(BIN)/pip install -q -e '.[all,robot]'
	@touch $@

$(VENV)/dev.stamp: pyproject.toml | $(VENV)/bin/python
	$(BIN)/pip install -q -e '.[dev]'
	@touch $@ $(VENV)/user.stamp
