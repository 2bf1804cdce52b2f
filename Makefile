# What a newcomer types: make demo, make test. Everything happens inside $(VENV); nothing else on the machine changes.

PYTHON ?= python3
VENV   ?= .venv
SHELL  := /bin/bash
.DEFAULT_GOAL := help

BIN := $(VENV)/bin
# Bytecode is compiled at the first import of what is used, which is far less than what is installed. It is kept, beside
# the files, whatever the caller prefers: tests start hundreds of programs, each of which would compile all of torch.
unexport PYTHONDONTWRITEBYTECODE
PIP := PYTHONUNBUFFERED=1 PIP_DISABLE_PIP_VERSION_CHECK=1 $(BIN)/python -m pip install \
       --no-compile --progress-bar off -c constraints.txt
# Of what pip says keep the lines that tell progress. Errors go to stderr and are always shown.
PROGRESS := $(BIN)/python -uc 'import sys; [print("   ", line.strip()[:90]) for line in sys.stdin \
            if line.strip().startswith(("Collecting", "Installing", "Successfully"))]'
# A process for each core, up to four, each with one thread: the tests are many and small.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile

# Packages that `make test-lowest` takes as they come, and what it runs.
LOWEST_BUT ?=
LOWEST_TESTS ?= tests/geometry tests/icosphere tests/cameras/test_camera_laws.py tests/crown/test_layers.py tests/crown/test_layout.py \
                tests/sweep tests/losses tests/metrics tests/scenes tests/data tests/models/test_network_laws.py tests/models/test_weights.py tests/io \
                tests/test_misuse.py tests/recipes/test_cli.py

.PHONY: help demo test test-all test-lowest mutants audit lint format docs notebooks bench house dist clean

help: ## list these targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: $(VENV)/.installed-recipes ## four rendered fisheye images to a 360° depth map; prints where the results are
	@$(BIN)/python -m sphericalvision.recipes.demo $(ARGS)

test: lint ## linters, then every test that is not slow
	@$(PYTEST) -m "not slow" $(ARGS)

test-all: lint ## linters, then every test
	@$(PYTEST) $(ARGS)

test-lowest: ## the core's tests with the lowest versions that pyproject.toml allows, in build/lowest
	@mkdir -p build && $(PYTHON) tests/lowest_versions.py $(LOWEST_BUT) > build/lowest.txt
	@echo "==> an environment with $$(wc -l < build/lowest.txt) lowest versions" && $(PYTHON) -m venv build/lowest
	@set -o pipefail; PYTHONUNBUFFERED=1 build/lowest/bin/python -m pip install --no-compile --progress-bar off -c build/lowest.txt \
	  -e '.[recipes]' pytest hypothesis | $(PROGRESS)
	@OMP_NUM_THREADS=1 build/lowest/bin/python -m pytest -m "not slow" $(LOWEST_TESTS) $(ARGS)

mutants: $(VENV)/.installed-all ## how many changes in the code no test notices, of a sample (mutmut); ARGS="--each 80 --seed 1"
	@$(BIN)/python -m mutmut --version > /dev/null 2>&1 || $(PIP) 'mutmut==3.8.1'
	@OMP_NUM_THREADS=1 $(BIN)/python -m tests.mutants $(ARGS)

audit: $(VENV)/.installed-all ## known vulnerabilities of everything that the tests of this release ran with (pip-audit)
	@$(BIN)/python -m pip_audit --version > /dev/null 2>&1 || $(PIP) pip-audit
	@$(BIN)/python -m pip_audit --no-deps --disable-pip -r tests/versions.txt $(ARGS)

lint: $(VENV)/.installed-all ## ruff, mypy, dead code and the import layers
	@echo "==> ruff check"   && $(BIN)/ruff check .
	@echo "==> ruff format"  && $(BIN)/ruff format --check .
	@echo "==> mypy"         && $(BIN)/mypy
	@echo "==> vulture"      && $(BIN)/vulture sphericalvision recipes tests/house_numbers.py $$(find sphericalvision -name '*.pyi')
	@echo "==> lint-imports"
	@# The linter reads folders, not the package-dir mapping of pyproject.toml: show it the installed layout.
	@rm -rf build/layers && mkdir -p build/layers && cp -R sphericalvision build/layers/
	@cp -R recipes conf build/layers/sphericalvision/
	@cd build/layers && $(abspath $(BIN))/lint-imports --no-cache --config $(CURDIR)/pyproject.toml

format: $(VENV)/.installed-all ## rewrite the code in the project's style
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

docs: $(VENV)/.installed-all ## build the documentation into site/; a warning is an error; PAGE=guide/crown.md builds one page alone
	@NO_MKDOCS_2_WARNING=1 PAGE=$(PAGE) $(BIN)/mkdocs build $(if $(PAGE),--quiet,--strict) --clean

house: $(VENV)/.installed-recipes ## how long, wide and deep the code is; ARGS=--chain lists the chain and the files of a frame
	@$(BIN)/python -m tests.house_numbers $(ARGS)

bench: $(VENV)/.installed-recipes ## measure speed; ARGS="groups=[cameras]" for a part of it
	@$(BIN)/python -m sphericalvision.recipes.speed $(ARGS)

notebooks: $(VENV)/.installed-all ## the tutorials as Jupyter notebooks, in notebooks/
	@$(BIN)/python docs/notebooks.py notebooks

# Links of the README lead to the repository URL, at the tag of the version; without URL they are left out.
URL ?=
dist: $(VENV)/.installed-all ## build sdist and wheel into dist/, and run the demo from the wheel; URL= of the repository
	@rm -rf dist build/dist && $(BIN)/python docs/release.py build/source $(URL)
	@$(BIN)/python -m build --no-isolation --outdir dist build/source > build-dist.log 2>&1 || { cat build-dist.log; exit 1; }
	@rm -f build-dist.log && ls -lh dist
	@echo "==> an empty environment" && $(PYTHON) -m venv build/dist
	@set -o pipefail; PYTHONUNBUFFERED=1 build/dist/bin/python -m pip install --no-compile --progress-bar off -c constraints.txt \
	  "$$(ls dist/*.whl)[recipes]" | $(PROGRESS)
	@cd build/dist && bin/python -m sphericalvision.recipes.demo output=$(CURDIR)/build/dist/demo
	@echo "Both files in dist/ are good. To publish: $(BIN)/python -m pip install twine && $(BIN)/python -m twine upload dist/*"

clean: ## remove what can be made again (the environment too)
	@rm -rf $(VENV) build dist site mutants .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache *.egg-info

# --- environment: made once, installed again only when pyproject.toml or constraints.txt change ---

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "sphericalvision needs Python 3.11 or newer; '$(PYTHON)' is $$($(PYTHON) --version 2>&1 || echo missing)." >&2; \
	  echo "Name another interpreter: make $(MAKECMDGOALS) PYTHON=python3.12" >&2; exit 1; }
	@echo "==> making a virtual environment in $(VENV)"
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
	  echo "'$(PYTHON) -m venv' failed; on Debian and Ubuntu: apt-get install python3-venv" >&2; exit 1; }

# torch goes first and alone: it is by far the largest, and pinning it keeps pip from trying other versions.
$(VENV)/.torch: $(VENV)/bin/python constraints.txt
	@echo "==> installing torch (the largest download; later runs skip this)"
	@set -o pipefail; $(PIP) torch | $(PROGRESS)
	@touch $@

$(VENV)/.installed-recipes: $(VENV)/.torch pyproject.toml
	@echo "==> installing sphericalvision with its recipes"
	@set -o pipefail; $(PIP) -e '.[recipes]' | $(PROGRESS)
	@touch $@

$(VENV)/.installed-all: $(VENV)/.torch pyproject.toml
	@echo "==> installing sphericalvision with its recipes, documentation and development tools"
	@set -o pipefail; $(PIP) -e '.[all]' | $(PROGRESS)
	@touch $@ $(VENV)/.installed-recipes
