# Everything a newcomer runs. Each target makes the virtual environment it needs; only Python 3.11, pip, make and git
# are taken for granted. Say PYTHON=/path/to/python3.11 if `python3` is another version.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
ARGS ?=

.PHONY: demo run test check lint types format benchmarks clean

demo: $(READY)
	$(BIN)/personalize demo $(ARGS)

run: $(READY)
	@test -n "$(VIDEO)" || { echo "usage: make run VIDEO=talk.mp4 [ARGS='--out DIR']" >&2; exit 2; }
	$(BIN)/personalize run "$(VIDEO)" $(ARGS)

# A file's tests stay together: they share what is slow to make.
test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadfile $(ARGS)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy

check: lint types test

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

benchmarks: $(READY)
	$(BIN)/python -m benchmarks $(ARGS)

# torch first and alone: the pinned version is a CPU build where one is at hand, and nothing later may replace it.
$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; assert sys.version_info[:2] == (3, 11), "Python 3.11 is needed; say PYTHON=..."'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch==2.13.0
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $(READY)

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
