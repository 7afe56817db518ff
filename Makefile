# make sample   merge the sample project into panorama.tif
# make test     get everything the tests need, then run them   [PYTEST_ARGS="tests/test_cli.py -x"]
# make lint     style, types, import rules
# make clean    remove what these made
#
# All of it happens in a virtual environment, .venv, that is made on the first call.

PANORAMA := panorama.tif
VENV := .venv
PY := $(VENV)/bin/python
PYTHON ?= $(shell for python in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$python && break; done)

# An environment whose Python is gone, or that points to a checkout elsewhere, is not current.
CURRENT := $(shell $(PY) -P -c "import importlib.util, os, sys; \
	spec = importlib.util.find_spec('hugin_abflow'); \
	sys.exit(not spec or os.path.realpath(spec.origin) != os.path.realpath('hugin_abflow/__init__.py'))" \
	2>/dev/null && echo yes)

# Debian's packages that the tests need, and the programs of theirs that are called.
PACKAGES := hugin-tools enblend enfuse libimage-exiftool-perl
PROGRAMS := nona pano_trafo hugin_executor enblend enfuse exiftool

# One test more at a time than there are cores: some wait for what they started. No more than four, whatever the
# machine has, as each process holds kernels and panoramas of its own.
CORES := $(shell getconf _NPROCESSORS_ONLN 2>/dev/null || echo 2)
PYTEST_ARGS ?= --numprocesses $(shell expr $(CORES) + 1) --maxprocesses 4 --dist worksteal

.PHONY: sample test lint clean programs FORCE

sample: $(VENV)/.installed-sample
	$(PY) -m hugin_abflow --prefix room --output $(PANORAMA) sample_projects/room/room.pto >/dev/null
	@echo "The panorama is $(CURDIR)/$(PANORAMA)"

test: programs $(VENV)/.installed-test
	$(PY) -m pytest $(PYTEST_ARGS)

lint: $(VENV)/.installed-lint
	$(PY) -m ruff check
	$(PY) -m ruff format --check
	$(PY) -m mypy
	$(VENV)/bin/lint-imports

clean:
	rm -rf $(VENV) $(PANORAMA) build dist .pytest_cache .hypothesis .mypy_cache .ruff_cache .import_linter_cache

EXTRAS_sample :=
EXTRAS_test := [test]
EXTRAS_lint := [test,lint]

$(VENV)/.installed-%: pyproject.toml $(if $(CURRENT),,FORCE)
	@test -n "$(PYTHON)" || { echo "hugin-abflow needs Python 3.11 or newer; install it, or name it: make PYTHON=..."; exit 1; }
	@$(PY) -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV) || { rm -rf $(VENV); \
		echo "$(PYTHON) cannot make a virtual environment; on Debian or Ubuntu: apt-get install python3-venv"; exit 1; }
	@echo "Installing hugin-abflow and what it needs into $(VENV) (this takes a few minutes the first time)"
	$(PY) -m pip install --quiet --disable-pip-version-check --editable ".$(EXTRAS_$*)"
	@touch $@

# Installs the programs through apt-get where that needs no password; elsewhere says what to install.
programs:
	@missing=; for program in $(PROGRAMS); do \
		command -v $$program >/dev/null || missing="$$missing $$program"; done; \
	test -n "$$missing" || exit 0; \
	echo "The tests need$$missing."; \
	if command -v apt-get >/dev/null && [ "$$(id -u)" = 0 ]; then sudo=; \
	elif command -v apt-get >/dev/null && sudo -n true 2>/dev/null; then sudo="sudo -n"; \
	else echo "Install Hugin's command line tools, enblend, enfuse and exiftool (Debian: apt-get install $(PACKAGES)), then try again."; exit 1; fi; \
	export DEBIAN_FRONTEND=noninteractive; \
	$$sudo apt-get update; \
	$$sudo apt-get install --yes --no-install-recommends $(PACKAGES)
