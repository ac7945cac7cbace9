# Each target sets up .venv by itself. Requires Python >= 3.11, and a C++ compiler for the native kernels.
#   make demo      train and mesh a small synthetic scene: runs/demo/report.html
#   make test      ruff, mypy and the fast tests (8 minutes on two cores)
#   make test-all  all tests (hours)
#   make test-gpu  tests that need an NVIDIA GPU; skipped without one
#   make fuzz      new mutated inputs, an hour per reader (SECONDS=60 FAMILIES="ply-mesh images"); findings in runs/fuzz
#   make docs      the documentation as a site: build/site/index.html; warnings and dead links are errors
#   make audit     licences and known vulnerabilities of the dependencies (the latter with pip-audit, if installed)
#   make lint      ruff, its formatter and mypy (`make types`: mypy alone)
#   make kernels   build the native library in the source tree, for development with PYTHONPATH=src
VENV := .venv
PY := $(VENV)/bin/python
PIP_INSTALL := $(PY) scripts/pip_install.py
# The first Python >= 3.11 found; `make PYTHON=/path/to/python` chooses another.
PYTHON ?= $(shell for p in python3.14 python3.13 python3.12 python3.11 python3 python; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 && { echo $$p; break; }; done)
WORKERS ?= 2
TEST_ARGS ?=
FAMILIES ?=
SECONDS ?= 3600

SOURCES := $(shell find src CMakeLists.txt pyproject.toml README.md LICENSE -type f \
	-not -path '*/__pycache__/*' -not -path 'src/gs2d/kernels/lib/*' 2>/dev/null)
# One thread per test worker: two workers share two cores. The kernels' own tests set their thread counts. Work stealing
# keeps neighbouring tests in one worker, so that what they share is made once.
TEST_ENV := OMP_NUM_THREADS=1 MPLBACKEND=Agg

.PHONY: demo test test-all test-gpu docs fuzz audit lint types kernels install clean

demo: $(VENV)/installed
	$(VENV)/bin/gs2d demo
	@echo "gs2d is $(VENV)/bin/gs2d; to type gs2d alone: . $(VENV)/bin/activate"

test: lint
	$(TEST_ENV) $(PY) -m pytest -m "not slow" -n $(WORKERS) --dist worksteal -q $(TEST_ARGS)

test-all: lint $(VENV)/docs
	$(TEST_ENV) $(PY) -m pytest -n $(WORKERS) --dist worksteal -q $(TEST_ARGS)

# One process: the tests share the device.
test-gpu: $(VENV)/installed
	$(TEST_ENV) $(PY) -m pytest -m gpu -q $(TEST_ARGS)

docs: $(VENV)/installed $(VENV)/docs
	$(PY) -m sphinx -E -W --keep-going -q -b html -c docs/site -d build/doctrees . build/site
	@echo "build/site/index.html"

# New inputs each day: the number of the first one is the date's.
fuzz: $(VENV)/installed
	$(TEST_ENV) $(PY) tests/fuzz/drive.py $(FAMILIES) --seconds $(SECONDS) --first $$(date +%Y%m%d000000) \
		--keep runs/fuzz

audit: $(VENV)/installed
	$(PY) scripts/audit.py

lint: $(VENV)/installed
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(MAKE) --no-print-directory types

types: $(VENV)/installed
	$(PY) -m mypy -n $(WORKERS)

install: $(VENV)/installed

kernels: $(VENV)/dependencies
	$(VENV)/bin/cmake -S . -B build/dev -G Ninja -DCMAKE_MAKE_PROGRAM=$(CURDIR)/$(VENV)/bin/ninja \
		-DCMAKE_BUILD_TYPE=Release
	$(VENV)/bin/cmake --build build/dev
	$(VENV)/bin/cmake --install build/dev --prefix src

clean:
	rm -rf build dist $(VENV)/installed

# The wheel as users get it (not editable): the tests test what is shipped. --no-build-isolation uses the pinned tools.
$(VENV)/installed: $(VENV)/dependencies $(SOURCES)
	@echo "compiling the kernels, minutes"
	@PATH="$(CURDIR)/$(VENV)/bin:$$PATH" $(PIP_INSTALL) --no-deps --no-build-isolation --force-reinstall .
	@touch $@

$(VENV)/docs: $(VENV)/dependencies
	$(PY) -c 'import tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
		print(*p["optional-dependencies"]["docs"], sep="\n")' > $(VENV)/docs-requirements.txt
	$(PIP_INSTALL) -c constraints.txt -r $(VENV)/docs-requirements.txt
	@touch $@

$(VENV)/dependencies: constraints.txt pyproject.toml
	@test -n "$(PYTHON)" || { \
		echo "error: no Python >= 3.11 found; install one, or run make PYTHON=/path/to/python" >&2; exit 1; }
	@test -x $(PY) || $(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
		echo "error: $(PYTHON) cannot make a virtual environment; on Debian: apt install python3-venv" >&2; exit 1; }
	@$(PY) -c 'import tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
		print("scikit-build-core", "cmake", "ninja", \
		*p["dependencies"], *p["optional-dependencies"]["dev"], sep="\n")' > $(VENV)/requirements.txt
	@echo "downloading the dependencies into $(VENV), minutes: on Linux 5 GB, as torch brings CUDA;" \
		"without a GPU see docs/guides/install.md#make"
	@$(PIP_INSTALL) --no-compile -c constraints.txt -r $(VENV)/requirements.txt
	@touch $@
