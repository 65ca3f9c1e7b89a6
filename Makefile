# make demo: install, then walk to a goal.   make test: install what tests need, then run all of them.
# make quick: the tests that take less than about a second each.
# make clean: remove the environment and caches; what was recorded and trained under runs/ stays.   PYTHON=... chooses the interpreter (3.11 or newer).

PYTHON ?= $(shell for p in python3.11 python3; do $$p -c '' 2>/dev/null && echo $$p && break; done)
VENV ?= .venv
BIN := $(VENV)/bin
# Two processes of one thread each, whatever the machine has: threads that wait for each other are slower. Where Python is
# told to keep no bytecode, each of the hundreds of commands that tests start would compile all of Servoid again.
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/pytest --numprocesses 2 --dist worksteal
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: demo test quick clean

demo: $(VENV)/.installed-demo
	mkdir -p runs && rm -f runs/demo.mcap runs/demo.mp4 runs/demo.png
	$(BIN)/servoid run goal --backend sim --seed 1 --record runs/demo.mcap --video runs/demo.mp4

test: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(PYTEST)

quick: $(VENV)/.installed-test
	$(PYTEST) -m "not slow"

# A stamp is newer than pyproject.toml once its packages are installed, so that nothing is installed twice.
$(VENV)/.installed-demo: pyproject.toml | $(BIN)/python
	$(PIP) install --editable '.[video]'
	touch $@

$(VENV)/.installed-test: pyproject.toml | $(BIN)/python
	$(PIP) install --editable '.[test]'
	@command -v chromium >/dev/null || { test "$$(id -u)" = 0 && apt-get -qq update && apt-get -qq install --yes --no-install-recommends chromium >/dev/null; } || \
		echo "no chromium: tests of the page in a browser are skipped (apt-get install chromium)" >&2
	touch $@ $(VENV)/.installed-demo

# Without python3-venv, Debian's Python makes half an environment and fails: the next make must not take it for done.
$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "no python3 found: install Python 3.11, or say make PYTHON=/path/to/python" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "$(PYTHON) is older than 3.11: say make PYTHON=/path/to/python3.11" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV) || { rm -f $@; exit 1; }

clean:
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
