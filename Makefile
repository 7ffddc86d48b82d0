# `make quickstart`: from a fresh clone to pictures of a trained model. Needs Python 3.11, 3.12 or 3.13 and make.
# Runs in the active virtual environment, else in .venv, which it makes with BASE_PYTHON: by default the first of these
# Pythons that is found. To change the Python of an existing .venv, delete it first.

ifdef VIRTUAL_ENV
VENV := $(VIRTUAL_ENV)
else
VENV := .venv
endif
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.apex_lab_installed
BASE_PYTHON ?= $(shell for name in python3.11 python3.12 python3.13; do \
	$$name -c '' 2>/dev/null && echo $$name && exit; done; echo python3)

.PHONY: quickstart predict install test test-all lint types contracts

quickstart: install
	$(BIN)/python -m apex_lab.train scale=quickstart

# The shipped weights on the shipped example; prints the folder with the overlay, masks, tracks and table.
predict: install
	$(BIN)/python -m apex_lab.predict checkpoint=apex-p2d-cpu video=examples/pushing.mp4

install: $(INSTALLED)

$(BIN)/python:
	$(BASE_PYTHON) -m venv $(VENV)

$(INSTALLED): pyproject.toml tests/no_deps.txt | $(BIN)/python
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	$(BIN)/python -m pip install --quiet --no-deps --requirement tests/no_deps.txt
	touch $@

test: install
	$(BIN)/python -m pytest -m "not slow and not gpu" -n auto

test-all: install
	$(BIN)/python -m pytest -n auto

lint: install
	$(BIN)/ruff check
	$(BIN)/ruff format --check

types: install
	$(BIN)/mypy

contracts: install
	$(BIN)/lint-imports
