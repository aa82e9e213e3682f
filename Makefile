# Verbs: `make install`, `make demo`, `make test`, `make check` (lint, format, types). Needs Python 3.11+, git and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
JURY := build/jury-venv

# Tests and guides start the package in many processes, which find it compiled.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install demo test test-slow test-gpu test-jury cpp fuzz torture check docs docs-pages docs-site format clean

install: $(READY)

# torch comes first, pinned: a range would fetch the newest build with its CUDA packages.
$(READY): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet "$$(grep '^torch==' constraints.txt)"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,docs]'
	touch $(READY)

demo: install
	rm -rf results/demo
	$(BIN)/gaitgauge evaluate pretrained --suite demo --out results/demo

test: install
	$(BIN)/python -m pytest -n auto --dist loadfile

test-slow: install
	$(BIN)/python -m pytest -m slow

test-gpu: install
	$(BIN)/python -m pytest -m gpu

# The engines of the extras in an environment of their own, on top of $(VENV): ovphysx wants another `packaging` than pytest 9.
test-jury: $(JURY)/.ready
	$(JURY)/bin/python -m pytest -n auto tests/backends/test_independent_engines.py

$(JURY)/.ready: $(READY)
	$(PYTHON) -m venv $(JURY)
	echo "import site; site.addsitedir('$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')')" \
		> "$$($(JURY)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/shared.pth"
	$(JURY)/bin/python -m pip install --quiet 'pytest<9' --editable '.[drake,physx]'
	touch $(JURY)/.ready

# The C++ controller of examples/. Needs apt, cmake, a C++ compiler and libyaml-cpp-dev.
cpp: install
	examples/cpp_controller/headers.sh build/onnxruntime
	ONNXRUNTIME_INCLUDE=$(CURDIR)/build/onnxruntime/usr/include/onnxruntime \
		$(BIN)/python -m pytest -m slow tests/policy/test_cpp_controller.py

# What somebody else may have written, against every parser: CASES of all of them together. Prints a table.
CASES ?= 100000
fuzz: install
	GAITGAUGE_FUZZ_CASES=$(CASES) $(BIN)/python -m pytest -n auto tests/fuzz

# Kills an evaluation KILLS times and resumes it; nothing may be lost.
KILLS ?= 100
torture: install
	$(BIN)/python benchmarks/torture.py --kills $(KILLS)

check: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	mkdir -p build/types && ln -sfn ../.. build/types/gaitgauge
	$(BIN)/mypy

# What the pages show is run, and the site is built with strict links; with `-j 2` at once.
docs: docs-pages docs-site

docs-pages: install
	$(BIN)/python -m pytest -n auto --dist worksteal -m 'not nightly' tests/docs

docs-site: install
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet

format: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) build dist *.egg-info
