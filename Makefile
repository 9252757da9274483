# ── The demonstration (make train): a run that shows learning in about ten minutes on two CPU cores ───────────────────
DEMO_TASK  = HalfCheetah-v5
DEMO_FLAGS = --steps 12000 --evaluate-every 2000
DEMO_OUT  := runs/first-$(shell date +%Y%m%d-%H%M%S)
# ──────────────────────────────────────────────────────────────────────────────────────────────────────────────────────

# Any of these can be set on the command line: make setup PYTHON=python3.12, make test ARGS="-k replay"
PYTHON  = python3
WORKERS = 2
ARGS    =

VENV = .venv
BIN  = $(VENV)/bin
PIP  = $(BIN)/python -m pip --disable-pip-version-check --quiet

.PHONY: help setup setup-dev peers train test test-slow test-extras test-gpu test-browser check format clean

help:
	@echo 'make setup      install mbdpg and its pinned requirements into $(VENV)'
	@echo 'make train      the ten-minute demonstration: learns $(DEMO_TASK)'
	@echo 'make test       the test suite (also: make test-slow, test-extras, test-browser, test-gpu)'
	@echo 'make check      lint, format, types, import rules'
	@echo 'make peers      install the programs that benchmarks/ compares with into $(VENV)-peers'
	@echo 'make format     mend what the linter and the formatter can mend'
	@echo 'make clean      remove $(VENV), $(VENV)-peers, caches and builds; runs/ stays'

setup: $(VENV)/.installed
setup-dev: $(VENV)/.installed-dev
peers: $(VENV)-peers/.installed

train: setup
	$(BIN)/mbdpg train $(DEMO_TASK) $(DEMO_FLAGS) --out $(DEMO_OUT)
	$(BIN)/mbdpg evaluate $(DEMO_OUT)/seed-0 --episodes 3 --video $(DEMO_OUT)/policy.mp4 || \
	  $(BIN)/mbdpg evaluate $(DEMO_OUT)/seed-0 --episodes 3
	@echo 'learning curve: $(DEMO_OUT)/learning-curve.png    video: $(DEMO_OUT)/policy.mp4'
	@echo 'next: $(BIN)/mbdpg resume $(DEMO_OUT)/seed-0 --steps 50000    goes on from here to a much better one'

test: setup-dev
	@$(BIN)/python -m pytest -q -n $(WORKERS) $(ARGS)

test-slow: setup-dev
	@XLA_FLAGS= JAX_DISABLE_MOST_OPTIMIZATIONS=0 $(BIN)/python -m pytest -q -m slow --timeout 3600 $(ARGS)

test-extras: $(VENV)/.installed-extras
	@$(BIN)/python -m pytest -q -m extras --timeout 600 $(ARGS)

test-gpu: setup-dev
	@JAX_PLATFORMS=$${JAX_PLATFORMS:-cuda,cpu} $(BIN)/python -m pytest -q -m gpu --timeout 600 $(ARGS)

test-browser: setup-dev
	@$(BIN)/python -m pytest -q -m browser $(ARGS)

check: setup-dev
	$(BIN)/ruff check --quiet --output-format concise
	$(BIN)/ruff format --check --quiet --output-format concise
	$(BIN)/mypy --no-error-summary
	@echo '$(BIN)/lint-imports'
	@$(BIN)/lint-imports --no-logo >$(VENV)/lint-imports.log || { cat $(VENV)/lint-imports.log; exit 1; }

format: setup-dev
	$(BIN)/ruff check --fix --quiet
	$(BIN)/ruff format --quiet

clean:
	rm -rf $(VENV) $(VENV)-peers build dist .mypy_cache .pytest_cache .ruff_cache .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Stamps: an environment is installed again only when what it is made from has changed.
$(BIN)/python:
	@command -v $(PYTHON) >/dev/null 2>&1 || \
	  { echo 'mbdpg needs Python 3.11, 3.12 or 3.13; there is no "$(PYTHON)" here. Try: make setup PYTHON=python3.12'; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' || \
	  { echo "mbdpg needs Python 3.11, 3.12 or 3.13; $(PYTHON) is $$($(PYTHON) --version 2>&1). Try: make setup PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -m venv $(VENV) >/dev/null 2>&1 || { rm -rf $(VENV); \
	  echo '$(PYTHON) cannot make a virtual environment: its venv or ensurepip part is missing. On Debian and Ubuntu: apt install python3-venv'; exit 1; }

$(VENV)/.installed: $(BIN)/python requirements.txt pyproject.toml
	@echo 'Installing into $(VENV): about 1.2 GB on disk, a few minutes the first time ...'
	@$(PIP) install -r requirements.txt
	@$(PIP) install --no-deps --editable .
	@touch $@
	@echo 'Ready: $(BIN)/mbdpg --help'

$(VENV)/.installed-dev: $(VENV)/.installed requirements-dev.txt
	@echo 'Installing the test and check tools ...'
	@$(PIP) install -r requirements-dev.txt
	@touch $@

$(VENV)/.installed-extras: $(VENV)/.installed-dev requirements-extras.txt
	@$(PIP) install -r requirements-extras.txt
	@touch $@

$(VENV)-peers/.installed: $(BIN)/python requirements-peers.txt
	@$(BIN)/python -m venv $(VENV)-peers
	@$(VENV)-peers/bin/python -m pip --disable-pip-version-check --quiet install -r requirements-peers.txt
	@touch $@
	@echo 'Ready: $(VENV)-peers/bin/python benchmarks/peers.py --help'
