# `make demo` and `make test` set up what they need in .venv (setup.sh says how); a second call starts at once.

SHELL := /bin/bash
# CI empties it, to run the slow tests too.
PYTEST_ARGS ?= -m "not slow"

.PHONY: demo test lint clean

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

.venv/ready: pyproject.toml setup.sh
	bash setup.sh
	touch $@

.venv/ready-tests: .venv/ready
	bash setup.sh tests
	touch $@

clean:
	rm -rf .venv build out *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
