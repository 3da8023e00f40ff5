# demo: brake the coach on the degraded track, and compute the same stop without WSP. docs: write the
# pages that are made from tables and tests, and the site of all pages in build/site. performance:
# measure the figures of docs/performance.md.
# Each target works from nothing: it creates .venv and installs pinned versions when needed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

# each test starts processes: bytecode is kept also where the shell says that it shall not be
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test nightly mutants kernel-can lint format docs pictures bench performance release clean

demo: $(VENV)/ready
	$(BIN)/rollerrig run velim_a1 --also-without-wsp --out runs/demo

# Two tiers of tests, see tests/README.md: `test` runs before each commit, `nightly` runs the others. Kernels are compiled
# before the workers start, each once. Three workers on two cores, because tests wait as often as they compute.
SUITE := $(BIN)/python -m pytest -n 3 --dist loadgroup

test: $(VENV)/ready-dev
	$(BIN)/python tests/compile_kernels.py
	$(SUITE) -m "not nightly"

nightly: $(VENV)/ready-dev
	$(BIN)/python tests/compile_kernels.py
	$(SUITE) -m nightly

# on kernel SocketCAN, in a guest that has it: a run to the byte as on the hub, the harness, what goes wrong on a bus
kernel-can: $(VENV)/ready-dev
	$(BIN)/python tests/compile_kernels.py
	$(BIN)/python tests/kernel_can/guest.py $(BIN)/python -m pytest -rs -p no:xdist -p no:cacheprovider \
	  tests/kernel_can tests/wsp_interface/test_buses.py tests/wsp_interface/test_hub.py

# which tests find faults that a developer could make (tests/mutants.toml), or some: make mutants FAULTS="hold_timer"
mutants: $(VENV)/ready-dev
	$(BIN)/python tests/mutants.py $(FAULTS)

lint: $(VENV)/ready-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@mkdir -p $(VENV)/typed/rollerrig
	@for room in rig firmware_sim wsp_interface realtime configs; do \
	  ln -sfn "$(CURDIR)/$$room" $(VENV)/typed/rollerrig/$$room; done
	MYPYPATH=$(VENV)/typed:tests $(BIN)/mypy -p rollerrig -p benchmarks -p endurance -p sealed -p paper

format: $(VENV)/ready-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/ready-dev
	$(BIN)/python -m pytest tests --collect-only -qq --write-docs=docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict

# every picture of the documentation, in light and in dark, or some: make pictures PICTURES="demo desk". It needs chromium
pictures: $(VENV)/ready-dev
	$(BIN)/python tests/compile_kernels.py
	PYTHONPATH=tests/realtime $(BIN)/python tests/pictures.py $(PICTURES)

# make bench NAME=contact runs another benchmark, or several: make bench NAME="hunting contact"
NAME = loop bus vehicle
bench: $(VENV)/ready
	$(BIN)/rollerrig bench $(NAME)

performance: $(VENV)/ready
	$(BIN)/rollerrig bench loop bus vehicle start contact hunting harness campaign soak fuzz kill --markdown docs/performance.md

# what is published: sdist, the wheel that is built from it, and the SBOM (CycloneDX) of the environment of the tests
RELEASE := build/release
release: $(VENV)/ready-dev
	rm -rf $(RELEASE)
	mkdir -p $(RELEASE)
	git ls-files -z | xargs -0 cp --parents -t $(RELEASE)
	$(BIN)/python -m build --no-isolation --outdir dist $(RELEASE)
	$(BIN)/cyclonedx-py environment $(BIN)/python --pyproject pyproject.toml --output-reproducible -o dist/rollerrig.cdx.json

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || \
	  { echo "rollerrig needs Python 3.11, 3.12 or 3.13; name one: make PYTHON=python3.12 ..."; exit 2; }
	$(PYTHON) -m venv $(VENV)

# without bytecode of all packages, of which a command needs a fifth: Python writes it when it first imports a file
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt

$(VENV)/ready: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) -e .
	@touch $@

$(VENV)/ready-dev: pyproject.toml constraints.txt | $(BIN)/python
	$(INSTALL) -e '.[dev]'
	@touch $@ $(VENV)/ready

clean:
	rm -rf $(VENV) build *.egg-info
