.DEFAULT_GOAL := help
SKINRIG := .venv/bin/skinrig
# bytecode is kept whatever the shell says: to read all tests takes a process 26 s without, 9 s with
PYTEST := PYTHONDONTWRITEBYTECODE= .venv/bin/python -m pytest
# a process more than there are cores, four at most: some wait, and kernels use several threads; one that ends ends all;
# files in the order of tests/conftest.py, the longest first, not that of how many tests they have
WORKERS := -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder --max-worker-restart 0

# make full RIG=flash: a rig at the size of its paper
RIG := dome

# make test-long PART=2/3: the second of three parts, each for a machine of its own
PART := 1/1

.PHONY: help setup browser firmware demo full test test-long lint docs bench clean

help:
	@echo "make demo       simulate, capture, calibrate, reconstruct, fuse, report (leaves ./demo)"
	@echo "make full       one rig at the size of its paper, in ./full-RIG (RIG=dome, flash, gradient or probe; hours)"
	@echo "make test       every test but the long ones"
	@echo "make test-long  the long ones (PART=2/3: the second of three parts)"
	@echo "make lint       ruff, mypy and the import contracts"
	@echo "make docs       the documentation site, into ./site (open site/index.html)"
	@echo "make browser    Chromium and what else the tests in a browser need (else they skip)"
	@echo "make firmware   firmware of the boxes, and what emulates its microcontrollers (else those tests skip)"
	@echo "make bench      error against run time of each stage"
	@echo "each sets up what it needs in .venv first"

setup: .venv/.ready

.venv/.ready: pyproject.toml constraints.txt tools/setup_environment.sh
	@tools/setup_environment.sh

browser: .venv/.ready
	@tools/setup_browser.sh

firmware:
	@tools/setup_firmware.sh

.venv/.demo: pyproject.toml constraints.txt tools/setup_environment.sh
	@tools/setup_environment.sh demo

demo: .venv/.demo
	@$(SKINRIG) demo --out demo

full: .venv/.ready
	@.venv/bin/python tools/measure_scales.py run $(RIG) --out full-$(RIG)

lint: .venv/.ready
	@.venv/bin/ruff check .
	@.venv/bin/ruff format --check .
	@.venv/bin/mypy
	@.venv/bin/lint-imports

test: .venv/.ready
	@$(PYTEST) -q $(WORKERS) -m "not long" --part $(PART)

test-long: .venv/.ready
	@$(PYTEST) -q $(WORKERS) --durations 25 -m long --part $(PART) tests

# the variable silences a note of mkdocs-material on its successor
docs: .venv/.ready
	@.venv/bin/python -c 'import material, mkdocs, mkdocstrings' 2>/dev/null || \
	  .venv/bin/python -m pip install -q --disable-pip-version-check -c constraints.txt --no-build-isolation -e '.[docs]'
	@NO_MKDOCS_2_WARNING=1 .venv/bin/python -m mkdocs build --quiet --strict --site-dir site

bench: .venv/.ready
	@$(SKINRIG) bench

clean:
	rm -rf .venv demo build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis node_modules site
