# `make demo`, `make test` and `make docs` set up what they need in .venv (see setup.sh); a second call starts at once.

SHELL := /bin/bash
# Compiled kernels and other caches: in the clone, so that a second run is warm and nothing is written in the home.
CACHES := XDG_CACHE_HOME="$(CURDIR)/build/cache" MPLCONFIGDIR="$(CURDIR)/build/cache/matplotlib"
# PYTEST_ARGS: more options, such as PYTEST_ARGS="-k line"
# Python caches its bytecode also where the environment forbids it: pytest compiles the tests anew in each process
# otherwise.
PYTEST = PYTHONDONTWRITEBYTECODE= .venv/bin/python -m pytest -n logical --maxprocesses 4 --dist worksteal $(PYTEST_ARGS)

.PHONY: demo test test-full test-rusticl nightly fuzz mutants offline offline-ci sanitize lint docs clean

demo: .venv/ready
	.venv/bin/gpuvision demo

# The tiers are explained in tests/conftest.py.
test: .venv/ready-tests
	$(PYTEST) --tier fast

test-full: .venv/ready-tests
	$(PYTEST) --tier full

# A few tests on Mesa's rusticl (Debian package mesa-opencl-icd), which runs kernels as a GPU does, on the CPU.
test-rusticl: export RUSTICL_ENABLE = llvmpipe
test-rusticl: export GPUVISION_DEVICE = rusticl
test-rusticl: .venv/ready-tests
	$(PYTEST) --tier fast --one-case

# With RUSTICL_ENABLE=llvmpipe also all tests on rusticl.
nightly: .venv/ready-tests
	$(PYTEST) --tier nightly
	$(MAKE) fuzz FUZZ_ARGS="--engine atheris --runs 20000 --seconds 60"
	$(MAKE) mutants
	$(MAKE) offline
	$(MAKE) sanitize

# Fuzz the readers of files: see tests/fuzz/run.py. FUZZ_ARGS: its options, and readers such as sensor.toml.
FUZZ_ARGS ?= --runs 100000
fuzz: .venv/ready-tests
	.venv/bin/python -m pip --quiet --disable-pip-version-check install --editable ".[fuzz]"
	.venv/bin/python tests/fuzz/run.py $(FUZZ_ARGS)

# Mutation tests: plant faults one at a time, run the tests: see tests/mutants/run.py. MUTANTS_ARGS: its options.
MUTANTS_ARGS ?= --sample 100 --seed 1
mutants: .venv/ready-tests
	.venv/bin/python -m pip --quiet --disable-pip-version-check install --editable ".[mutants]"
	.venv/bin/python tests/mutants/run.py $(MUTANTS_ARGS)

# Compile the kernels for GPUs that need not be present (Debian packages clang-16 and libclc-16). OFFLINE_ARGS: targets
# and options of `gpuvision profile`. Compiled kernels are cached: a second run compiles only the changed ones.
OFFLINE_ARGS ?= --offline sm_70 --offline sm_90 --offline gfx90a --offline gfx1100
offline: .venv/ready-offline
	$(CACHES) .venv/bin/gpuvision profile $(OFFLINE_ARGS)

# A kernel of each file for AMD, all builds for NVIDIA: 100 s of processor time if nothing is cached.
offline-ci: .venv/ready-offline
	$(CACHES) .venv/bin/gpuvision profile --offline sm_90
	$(CACHES) .venv/bin/gpuvision profile --offline gfx90a --one-build

# Run all kernels in the simulator oclgrind (Debian package oclgrind): accesses beyond an array, data races. See
# tests/sanitize.py. KERNELS: some kernel files, such as KERNELS="psd line".
sanitize: .venv/ready-tests
	.venv/bin/python tests/sanitize.py $(KERNELS)

# Type checkers do not understand setuptools' package-dir or its import hook for editable installs. Symbolic links in
# build/lint give the package the layout of an installed wheel, so that messages name the real files.
lint: .venv/ready-tests
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	rm -rf build/lint/gpuvision
	mkdir -p build/lint/gpuvision
	ln -s "$(CURDIR)"/{gpuvision/*,host,kernels,profiling,tests/reference} build/lint/gpuvision
	cd build/lint && "$(CURDIR)/.venv/bin/mypy" --config-file "$(CURDIR)/pyproject.toml"

# Warnings are errors. Sphinx-gallery runs the examples that changed since the last build, on the best device. The pages
# are in build/docs. --fresh-env reads every page again: an incremental build would drop the index entries of unchanged
# pages from the search index.
docs: .venv/ready-docs
	$(CACHES) .venv/bin/python -m sphinx --fresh-env --fail-on-warning --keep-going --quiet -d build/doctrees docs build/docs
	@echo "open build/docs/index.html"

.venv/ready: pyproject.toml setup.sh
	bash setup.sh
	touch $@

.venv/ready-tests .venv/ready-docs .venv/ready-offline: .venv/ready-%: .venv/ready
	bash setup.sh $*
	touch $@

clean:
	rm -rf .venv build out docs/gallery docs/reference/api docs/reference/commands docs/results/runs *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
