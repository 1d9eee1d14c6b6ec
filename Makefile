# SPDX-License-Identifier: GPL-3.0-or-later
# Every target works as the first command in a fresh clone: it makes the environment when that is missing.
VENV ?= .venv
PYTHON ?= python3
RUN = $(VENV)/bin/python
DOCS_VENV ?= .venvs/docs
STAMP = $(VENV)/gskin-setup.sha256

.DEFAULT_GOAL := help
.PHONY: help venv demo test test-versions test-window test-runtime lint words zip repository docs bench-speed bench-quality bench-paper clean

help:
	@echo 'make venv           the environment in $(VENV), with all that gskin needs'
	@echo 'make demo           a sample character, auto-skinned, into out/demo'
	@echo 'make test           the test suite'
	@echo 'make test-versions  what needs bpy, under pip bpy 4.5, 5.0, 5.2 and 5.3; ONLY=5.2,5.3 chooses'
	@echo 'make test-window    the extension in real Blender windows; BLENDER=/path/to/blender, else (as root) 4.3 and 5.2 of Debian'
	@echo 'make test-runtime   the learning runtime for real, from the package index pip is set up for: minutes, 5 GB'
	@echo 'make lint           ruff and mypy'
	@echo 'make zip            the Blender extension, into dist'
	@echo 'make repository     that, with the listing that Blender installs and updates from, into dist/repository'
	@echo 'make docs           the documentation as a site, into out/docs; strict: a dead link fails'
	@echo 'make bench-speed    every bar of speed and memory; ONLY=iteration,standard and REPEATS=3 choose'
	@echo 'make bench-quality  all ways to make weights, on assets with known ones; tables into docs/benchmarks.md'
	@echo "make bench-paper    the paper's tables in its protocol; SAMPLE=4 chooses how many assets"

$(STAMP): pyproject.toml tools/make_venv.py
	@$(PYTHON) tools/make_venv.py --venv $(VENV)

venv: $(STAMP)

demo: $(STAMP)
	@$(RUN) -m demo --out out/demo

# One thread of torch per process: with two for each of two cores they wait for one another for minutes.
test: $(STAMP)
	@OMP_NUM_THREADS=1 $(RUN) -m pytest -n auto --maxprocesses 4 --dist loadfile

test-versions:
	@$(PYTHON) tests/versions $(if $(ONLY),--only $(ONLY))

test-window: $(STAMP)
	@$(RUN) tests/window $(if $(PICTURES),--pictures)

test-runtime: $(STAMP)
	@$(RUN) tests/runtime

lint: $(STAMP)
	@$(RUN) -m ruff check .
	@$(RUN) -m mypy

# The words of the interface, for translators; after a change of what is drawn.
words: $(STAMP)
	@$(RUN) tools/collect_words.py

zip: $(STAMP)
	@$(RUN) tools/build_zip.py --out dist

repository: $(STAMP)
	@$(RUN) tools/build_repository.py --out dist/repository

# A small environment of its own: what builds the site is no part of what gskin needs.
$(DOCS_VENV)/gskin-setup.stamp: pyproject.toml
	@$(PYTHON) -m venv --clear $(DOCS_VENV)
	@$(DOCS_VENV)/bin/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["docs"], sep="\n")' > $(DOCS_VENV)/docs.txt
	@$(DOCS_VENV)/bin/python -m pip install -q -r $(DOCS_VENV)/docs.txt
	@touch $@

docs: $(DOCS_VENV)/gskin-setup.stamp
	@NO_MKDOCS_2_WARNING=1 $(DOCS_VENV)/bin/python -m mkdocs build --strict

bench-speed: $(STAMP)
	@$(RUN) -m benchmarks.bench_speed $(if $(ONLY),--only $(ONLY)) $(if $(REPEATS),--repeats $(REPEATS))

bench-quality: $(STAMP)
	@$(RUN) -m benchmarks.quality

bench-paper: $(STAMP)
	@$(RUN) -m benchmarks.paper $(if $(SAMPLE),--sample $(SAMPLE)) $(if $(LPIPS),--lpips $(LPIPS))

clean:
	rm -rf out build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
