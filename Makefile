# `make` lists the targets. The first one used builds the environment, .venv; nothing is needed before it but
# Python 3.11 to 3.14, make and a C compiler. Pip's own settings (PIP_INDEX_URL, PIP_FIND_LINKS, ...) say where packages
# come from, and so whether torch is its CPU or its CUDA build.

# Deferred: looked up only when the environment is made. Override with `make PYTHON=...`.
# Python 3.11 first: PyBullet, the quadrotor's simulator, has no wheels for later versions.
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3.14 python3; do \
	$$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' 2>/dev/null && echo $$p && break; done)
PY  := .venv/bin/python
PIP := $(PY) -m pip --disable-pip-version-check -qq install -c constraints.txt --no-build-isolation
ENV := .venv/.complete
ARGS ?=
HAS_PYBULLET = $(PY) -c 'import pybullet' >/dev/null 2>&1

.DEFAULT_GOAL := help
.PHONY: help reproduce test bench fuzz mutants audit oldest docs lint package sanitize clean distclean

help:  ## list the targets
	@sed -n 's/^\([a-z]*\):.*## /  make \1\t/p' $(MAKEFILE_LIST) | expand -t 20

# One line a script, in the order in which they run.
reproduce: $(ENV)  ## the paper's figures and tables, into results/
	@mkdir -p results
	@$(HAS_PYBULLET) || echo "NOTE: without PyBullet (wheels up to Python 3.11) Figure 4 is left out; Figure 3, Table I and the report follow."
	$(PY) -m scripts.figure3_masses
	@if $(HAS_PYBULLET); then set -x; $(PY) -m scripts.figure4_quadrotor; fi
	$(PY) -m scripts.table1_sizes
	$(PY) -m scripts.report

# The numerical tests run a second time without the kernels: the path of a GPU, and of a machine without a compiler.
NUMERICAL := tests/solve/test_gradients.py tests/solve/test_engines.py tests/solve/test_guards.py tests/fuzz/test_fuzz.py \
	tests/sets/test_convex_sets.py tests/problem/test_reduction.py tests/problem/test_terms.py \
	tests/solve/test_optimality.py tests/solve/test_last_resort.py tests/problem/test_degenerate_data.py
test: $(ENV)  ## every test and docstring example (ARGS="-m 'not slow'" for the quick ones)
	@ignore=; $(HAS_PYBULLET) || ignore=--ignore=torch_dpc/systems/quadrotor.py; \
	set -x; $(PY) -m pytest -n auto --dist worksteal tests --doctest-modules torch_dpc baselines $$ignore $(ARGS) && \
	{ TORCH_DPC_NO_KERNELS=1 $(PY) -m pytest -q -n auto -m "not slow" $(NUMERICAL) $(ARGS) || test $$? -eq 5; }

bench: $(ENV)  ## time and error of the layer (ARGS=--quick for a short run, ARGS=--check for the regression guard)
	$(PY) -m scripts.benchmark $(ARGS)

fuzz: $(ENV)  ## 10,000 random problems against an independent reference (ARGS="-n 100"; resumes where it was stopped)
	$(PY) -m tests.fuzz $(ARGS)

mutants: $(ENV)  ## wrong changes of the core, each of which a test must notice (resumes; about 20 minutes)
	$(PY) -m tests.mutants $(ARGS)

audit: $(ENV)  ## known vulnerabilities of the exact versions in constraints.txt (asks PyPI)
	@$(PY) -m pip_audit --version >/dev/null 2>&1 || $(PIP) pip-audit
	$(PY) -m pip_audit --strict --no-deps --disable-pip -r constraints.txt

# An environment of its own, with the lower bounds of setup.cfg as exact versions; pytest and hypothesis as they come.
oldest: $(ENV)  ## the tests of the core with the oldest versions that setup.cfg admits (torch may bring CUDA: 3 GB)
	@test -x .venv-oldest/bin/python || $(PYTHON) -m venv .venv-oldest
	$(PY) tests/oldest.py save > .venv-oldest/constraints.txt
	.venv-oldest/bin/python -m pip --disable-pip-version-check -q install setuptools pytest pytest-xdist hypothesis clarabel \
	-c .venv-oldest/constraints.txt $$(sed 's/==.*//' .venv-oldest/constraints.txt)
	PYTHONPATH=$$PWD .venv-oldest/bin/python -m pytest -q -n auto -p no:cacheprovider -m "not slow" tests/test_layer.py \
	tests/test_saving.py tests/sets tests/solve tests/problem tests/data tests/control tests/attacks tests/tuning $(ARGS)

docs: .venv/.complete-docs  ## the documentation, into site/
	$(PY) -m sphinx -q -W --keep-going docs site
	@echo "Open site/index.html"

lint: $(ENV)  ## ruff, mypy and the direction of imports
	$(PY) -m ruff check .
	$(PY) -m mypy
	@.venv/bin/lint-imports --no-logo

# The extension is built once a sanitizer, in build/; the interpreter is not, so the sanitizer's library is preloaded.
# Python keeps memory until it ends, which is no leak. The thread sanitizer takes the fuzz alone: torch has no build for it.
SANITIZED = build/sanitize-$(1)/lib*/torch_dpc/solve/_kernels*.so
sanitize: $(ENV)  ## the kernels under the address, undefined-behaviour and thread sanitizers of gcc (2 minutes)
	@for kind in address,undefined thread; do \
	CFLAGS="-O1 -g -Werror -Wno-unused-function -DTORCH_DPC_PLAIN -fno-omit-frame-pointer -fno-sanitize-recover=all -fsanitize=$$kind" LDFLAGS=-fsanitize=$$kind \
	$(PY) setup.py -q build --build-base build/sanitize-$${kind%%,*} || exit 1; done
	LD_PRELOAD=$$(gcc -print-file-name=libtsan.so) $(PY) tests/solve/fuzz_kernels.py 20000 $(call SANITIZED,thread)
	export LD_PRELOAD="$$(gcc -print-file-name=libasan.so) $$(gcc -print-file-name=libubsan.so)" ASAN_OPTIONS=detect_leaks=0; \
	$(PY) tests/solve/fuzz_kernels.py 20000 $(call SANITIZED,address) && root=$$PWD && cd build/sanitize-address/lib* && \
	PYTHONPATH=$$PWD $$root/$(PY) -m pytest -q -p no:cacheprovider -k "not without" \
	$$root/tests/solve/test_kernels.py $$root/tests/solve/test_kernel_sets.py

# The README runs from an empty folder, so that what it imports is the wheel; pip must not find the sources on PYTHONPATH.
package: export PYTHONPATH :=
package: $(ENV)  ## sdist and wheel into dist/, tried in a clean environment with the core dependencies alone
	rm -rf dist build/clean && $(PY) -m build -n -o dist .
	$(PY) -m venv build/clean
	build/clean/bin/python -m pip --disable-pip-version-check -qq install -c constraints.txt dist/*.whl
	mkdir -p build/empty && cd build/empty && PATH=../clean/bin:$$PATH && python -W error -c 'import torch_dpc' && \
	python ../../tests/run_readme.py ../../README.md && python -c 'from torch_dpc.solve import kernels; print("vector instructions:", kernels.instructions())'

clean:  ## remove what the other targets leave, but keep .venv
	rm -rf results site jupyter_execute .jupyter_cache build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
	find . -name .venv -prune -o -name __pycache__ -type d -exec rm -rf {} +

distclean: clean  ## remove .venv and the compiled kernels too
	rm -rf .venv torch_dpc/solve/*.so

# The stamp is written last, so an install that failed or was interrupted is taken up again by the next run.
# An environment without a working pip was cut short before it was of use to anybody: it is begun anew.
$(ENV): setup.cfg setup.py constraints.txt torch_dpc/solve/_kernels.c $(wildcard torch_dpc/solve/*.h)
	@$(PY) -m pip --version >/dev/null 2>&1 || { \
	test -n "$(PYTHON)" || { echo "No Python from 3.11 to 3.14 was found: install one, or name it with make PYTHON=..."; exit 1; }; \
	echo "Creating .venv with $(PYTHON) (about 2 minutes the first time) ..."; $(PYTHON) -m venv --clear .venv; }
	@echo "[1/4] PyTorch ..."
	@$(PIP) setuptools torch
	@echo "[2/4] torch_dpc, test tools, plotting ..."
	@$(PIP) -e '.[scripts,dev,save]'
	@echo "[3/4] quadrotor simulator ..."
	@$(PIP) --only-binary pybullet -e '.[quadrotor]' 2>/dev/null || $(call without,PyBullet and so the quadrotor: it has wheels up to Python 3.11)
	@echo "[4/4] baselines ..."
	@$(PIP) -e '.[baselines]' || $(call without,the cvxpylayers and QPLayer baselines)
# qpth works with numpy 2 but declares numpy<2, and pip would take cvxpy and cvxpylayers back years to please it.
	@$(PIP) --no-deps qpth || $(call without,the qpth baseline)
	@touch $@

.venv/.complete-docs: $(ENV)
	@echo "Installing the documentation tools ..."
	@$(PIP) -e '.[docs]'
	@touch $@

# torch_dpc works without the simulator and the baselines, so one that cannot be had here does not stop the rest.
without = echo "NOTE: this environment is without $(1); the rest works. To try again: touch setup.cfg"
