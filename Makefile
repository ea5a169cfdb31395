# Two commands do everything on a machine with Python 3.11+, pip and make: `make demo` and `make test`.
PYTHON ?= python3

.PHONY: demo test lint clean

demo: .venv/installed  ## look at a sample object, with the base installation (no torch)
	.venv/bin/nextview demo --figure nextview_demo.png

test: .venv-test/installed  ## run all tests
	.venv-test/bin/python -m pytest

lint: .venv-test/installed  ## style and types
	.venv-test/bin/ruff check .
	.venv-test/bin/ruff format --check .
	.venv-test/bin/mypy

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	.venv/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

.venv-test/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv-test
	.venv-test/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[train,benchmark,cluster,dev]'
	touch $@

clean:
	rm -rf .venv .venv-test nextview_demo.png
