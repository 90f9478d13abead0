# `make run`: the example; `make test`: all tests; `make check`: what a change must pass.
PYTHON ?= python
INPUT ?= example
PRESET ?= preview

.PHONY: install run test check bench

install:
	$(PYTHON) -m pip install -c constraints.txt -e '.[dev,bench]'

run:
	$(PYTHON) -m flows.cli run $(INPUT) --preset $(PRESET)

test:
	$(PYTHON) -m pytest

check:
	ruff format --check .
	ruff check .
	mypy
	$(PYTHON) -m pytest -m 'not slow and not gpu and not browser'

bench:
	$(PYTHON) -m flows.cli chart $(wildcard $(SVIM3D_DATA)/orbits/*)
