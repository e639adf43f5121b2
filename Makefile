# `make demo`, `make test` and `make docs` set up what they need in .venv (see setup.sh); a second call starts at once.

SHELL := /bin/bash
# CI empties it, to run the slow tests too.
PYTEST_ARGS ?= -m "not slow"

.PHONY: demo test lint docs clean

demo: .venv/ready
	.venv/bin/gpuvision demo

test: .venv/ready-tests
	.venv/bin/python -m pytest -n logical --maxprocesses 4 --dist worksteal $(PYTEST_ARGS)

# Type checkers follow neither setuptools' package-dir nor its hook for editable installs. The package is laid out
# for them in links, as a wheel would install it: no build, no network, and messages lead to the real file.
lint: .venv/ready-tests
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	rm -rf build/lint/gpuvision
	mkdir -p build/lint/gpuvision
	ln -s "$(CURDIR)"/{gpuvision/*,host,kernels,profiling} build/lint/gpuvision
	cd build/lint && "$(CURDIR)/.venv/bin/mypy" --config-file "$(CURDIR)/pyproject.toml"

# Warnings are errors. Changed examples run, on the best device; the pages are in build/docs. Every page is read anew:
# Sphinx drops the index entries of the others from the search index.
docs: .venv/ready-docs
	.venv/bin/python -m sphinx --fresh-env --fail-on-warning --keep-going --quiet -d build/doctrees docs build/docs
	@echo "open build/docs/index.html"

.venv/ready: pyproject.toml setup.sh
	bash setup.sh
	touch $@

.venv/ready-tests: .venv/ready
	bash setup.sh tests
	touch $@

.venv/ready-docs: .venv/ready
	bash setup.sh docs
	touch $@

clean:
	rm -rf .venv build out docs/gallery docs/reference/api docs/reference/commands docs/results/runs *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
