# The whole path from recorded flights to figures, tests and paper. `make help` lists the targets.
# Written for GNU make 3.81 and later. Every product is a file target, so -j works and nothing is made twice.

PYTHON ?= python3
PY := .venv/bin/python

# Matrices here are small: on a busy machine OpenBLAS's threads wait for each other. tests/conftest.py sets the same.
export OPENBLAS_NUM_THREADS := 1

# What is made, from what: written by fiplib/products.py, read here for the targets that need it.
ifneq ($(filter figures paper bags fly-% figures/% paper/% .make/%,$(MAKECMDGOALS)),)
include .make/products.mk
endif
FIGURE_FILES := $(foreach name,$(PRODUCTS),$(files_$(name)))
CLAIM_FILES := figures/claims.csv figures/claims.txt paper/generated/numbers.tex paper/generated/claims-table.tex
FLIGHTS := $(BAGS:%=fly-%)

# What `make sweep` runs, and how: make sweep STUDIES='survival --limit 10'. One worker process per core; with
# DASK_SCHEDULER_ADDRESS=tcp://host:8786 in the environment, or on make's command line, the workers of that scheduler.
STUDIES := --all

# What `make bench` measures, one process each: make bench BENCH='mpc bags'.
BENCH := mpc estimation bags flights growth

LATEX_PACKAGES := texlive-latex-extra texlive-publishers texlive-science texlive-bibtex-extra latexmk cm-super

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.SUFFIXES:
MAKEFLAGS += --no-builtin-rules

.PHONY: help figures test fuzz notebooks lab book pdf slides student film bags sweep bench paper latex lint audit clean

help: #+ show this list
	@echo "make TARGET; every target sets up .venv by itself where it needs it"
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  %-9s  %s\n", $$1, $$2 }' Makefile
	@awk -F ':' '/^[a-z-]+:.*#[+] / { others = others " " $$1 } END { print "  others, described in the Makefile:" others }' Makefile

figures: $(FIGURE_FILES) $(GALLERY_FILES) $(CLAIM_FILES) ## make every figure and table of the paper, and print the claims ledger
	@cat figures/claims.txt

test: .venv/installed ## run the tests, and the notebooks with small settings, on every core
	@FIP_FAST=1 $(PY) -m pytest -n auto --dist loadgroup -m "not realtime" --nbmake notebooks tests; status=$$?; \
	    $(PY) -m pytest -m realtime tests && exit $$status

# Seconds of each fuzzer, and its seed: make fuzz FIP_FUZZ_SECONDS=600 FIP_FUZZ_SEED=7. In make test each takes 20 s.
fuzz: .venv/installed #+ fuzz bags, failsafe and command line for an hour; each failure prints how to repeat it
	@seconds=$${FIP_FUZZ_SECONDS:-1800}; seed=$${FIP_FUZZ_SEED:-$$(date +%s)}; echo "seed $$seed"; \
	    FIP_FUZZ_SECONDS=$$seconds FIP_FUZZ_SEED=$$seed $(PY) -m pytest -n 2 -m fuzz tests

notebooks: .venv/installed #+ run every notebook at full length; nothing is written into them
	@$(PY) -m pytest -n auto --nbmake --nbmake-timeout 3600 --verbose notebooks

# Jupyter refuses to run as root, which one is in a container, without --allow-root. For a container see docs/faq.md.
lab: .venv/installed ## open JupyterLab on the first notebook (options of Jupyter: make lab LAB='...')
	$(PY) -m jupyterlab --LabApp.default_url=/lab/tree/notebooks/00-start-here.ipynb \
	    --LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate \
	    $(if $(filter 0,$(shell id -u)),--allow-root) $(LAB)

book: .venv/installed ## make the book: notebooks with their results, and the library, docs/build/html
	@$(PY) docs/book.py

film: .venv/installed #+ make the film of the README from a recorded flight, docs/static/film.webp
	$(PY) -m fiplib.teaching.film data/estimate-1.4 docs/static/film.webp

pdf: .venv/installed #+ print the book as one PDF, docs/build/fip.pdf (needs chromium)
	@$(PY) docs/book.py --pdf

slides: .venv/installed #+ make the slides of three lectures from the notebooks, docs/build/slides
	@$(PY) docs/slides.py

student: .venv/installed ## make a copy for students without solutions, build/student and build/student.zip
	@$(PY) -m fiplib.teaching.handout build/student

bags: $(FLIGHTS) ## fly the simulator again and rewrite data/ (one flight alone: make fly-circle-0.8)
	$(PY) -m fiplib.reproduction.stored $(foreach name,$(BAGS),data/$(name)/$(name).mcap data/$(name)/metadata.yaml)

# The maximum-likelihood estimator solves its least squares by LAPACK: the seventh digit of its lengths depends on which
# kernels OpenBLAS and NumPy choose for the CPU. Pinned, a table of lengths is the same on every x86-64 since 2013.
sweep: export OPENBLAS_CORETYPE := Haswell
sweep: export NPY_DISABLE_CPU_FEATURES := X86_V4 AVX512_ICL AVX512_SPR
sweep: .venv/installed ## run the studies behind data/sweeps/, for hours; it can be stopped and resumed
	$(PY) -m fiplib sweep $(STUDIES)

bench: .venv-bench/installed ## time everything beside its alternatives, each topic in a process: benchmarks/results.csv
	@set -e; for topic in $(BENCH); do .venv-bench/bin/python -m benchmarks.$$topic --save; done

paper: latex paper/build/main.pdf ## typeset the reproduction report, paper/build/main.pdf (needs LaTeX)
	@echo "The report is in paper/build/main.pdf"

latex: #+ check for the LaTeX that the report needs, and say what to install
	@if ! command -v latexmk >/dev/null || ! kpsewhich elsarticle.cls siunitx.sty >/dev/null; then \
	    echo "The report needs LaTeX with latexmk. On Debian or Ubuntu:" >&2; \
	    echo "  sudo apt-get install $(LATEX_PACKAGES)" >&2; \
	    echo "Elsewhere: TeX Live or MacTeX in full. Figures and tests need none of it." >&2; \
	    exit 1; \
	fi

lint: .venv/installed ## check style, format, types and stripped notebooks
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy
	$(if $(wildcard notebooks/*.ipynb),$(PY) -m nbstripout $(STRIP) --verify notebooks/*.ipynb)

audit: .venv-audit/installed #+ ask the database of Python's advisories about every locked version (needs the network)
	@for lock in requirements.lock benchmarks/requirements.lock; do \
	    .venv-audit/bin/pip-audit --disable-pip --require-hashes --requirement $$lock || exit 1; done

clean: #+ remove what was made; data/, .venv and the page figures/README.md stay
	rm -f $(foreach suffix,pdf png csv tex txt,figures/*.$(suffix))
	rm -rf .make build paper/build paper/generated docs/build .pytest_cache .ruff_cache .hypothesis
	find fiplib scripts tests benchmarks docs -name __pycache__ -exec rm -rf {} +

LAB_SETTINGS := {"@jupyterlab/apputils-extension:notification": {"fetchNews": "false", "checkForUpdates": false}}
LAB_HOOK := {"FileContentsManager": {"post_save_hook": "fiplib.teaching.saved.after_save"}}

# --- set-up: two steps, so that an edit of pyproject.toml does not install every package again. Each marker is written
# last, so an interrupted step starts afresh.
.venv/locked: requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "fip needs Python 3.11 or later, and '$(PYTHON)' is not that. Name one: make PYTHON=python3.12 ..." >&2; exit 1; }
	@echo "Setting up .venv: a minute or so, most of it download"
	$(PYTHON) -m venv --clear .venv
	$(PY) -m pip install --disable-pip-version-check --require-hashes --requirement requirements.lock
	@touch $@

.venv/installed: .venv/locked pyproject.toml
	$(PY) -m pip install --disable-pip-version-check --quiet --no-deps --no-build-isolation --editable .
	@mkdir -p .venv/share/jupyter/lab/settings
	@echo '$(LAB_SETTINGS)' > .venv/share/jupyter/lab/settings/overrides.json
	@mkdir -p .venv/etc/jupyter/jupyter_server_config.d
	@echo '$(LAB_HOOK)' > .venv/etc/jupyter/jupyter_server_config.d/fip.json
	@echo "Compiling the loops of controller, filter and simulator: half a minute, once"
	@$(PY) -c 'from fiplib import kernels; kernels.load()'
	@$(MAKE) --no-print-directory notebook-filter
	@touch $@

# Running a notebook changes its file, not the repository: git strips what it reads from notebooks (.gitattributes), and
# JupyterLab asks it to read after each save (LAB_HOOK). Only at the top of a work tree of our own. A clone without .venv,
# or without this step, works on unstripped files.
STRIP := --keep-id --extra-keys '$(foreach key,version codemirror_mode file_extension mimetype nbconvert_exporter \
    pygments_lexer,metadata.language_info.$(key))'
.PHONY: notebook-filter
notebook-filter:
	@if test -z "$$(git rev-parse --show-prefix 2>/dev/null || echo none)"; then \
	    git config filter.notebooks.clean "if test -x $(PY); then $(PY) -m nbstripout $(STRIP); else cat; fi" && \
	    git config filter.notebooks.smudge cat && git config filter.notebooks.required false; fi

# The rivals of the benchmarks: their own environment and their own lock, so that figures and tests stay light.
.venv-bench/locked: benchmarks/requirements.lock
	$(PYTHON) -m venv --clear .venv-bench
	.venv-bench/bin/python -m pip install --disable-pip-version-check --require-hashes --requirement $<
	@touch $@

.venv-bench/installed: .venv-bench/locked pyproject.toml
	.venv-bench/bin/python -m pip install --disable-pip-version-check --quiet --no-deps --no-build-isolation --editable .
	@touch $@

# The auditor is no part of what it audits: it gets an environment of its own, and the newest version of itself.
.venv-audit/installed:
	$(PYTHON) -m venv --clear .venv-audit
	.venv-audit/bin/python -m pip install --disable-pip-version-check --quiet pip-audit
	@touch $@

# --- figures, tables, claims. One process draws all that is out of date: a product whose files are missing or which has a
# source newer than the stamp. A stamp has the time at which its drawing began, so that an edit meanwhile counts.
missing = $(filter-out $(wildcard $(1)),$(1))
stale = $(foreach name,$(PRODUCTS),$(if $(filter $(sources_$(name)),$?)$(call missing,$(files_$(name))),$(name)))

.make/products.mk: .venv/installed
	@mkdir -p .make
	@$(PY) -m fiplib figures --make > $@.new
	@mv $@.new $@

.make/figures: $(sort $(foreach name,$(PRODUCTS),$(sources_$(name)))) $(if $(call missing,$(FIGURE_FILES)),absent) | .venv/installed
	@touch $@.begun
	$(PY) -m fiplib figures $(strip $(stale))
	@mv $@.begun $@

.make/gallery: $(sources_gallery) $(if $(call missing,$(GALLERY_FILES)),absent) | .venv/installed
	@touch $@.begun
	$(PY) -m fiplib figures gallery
	@mv $@.begun $@

.make/claims: $(sources_claims) $(if $(call missing,$(CLAIM_FILES)),absent) | .venv/installed
	@touch $@.begun
	$(PY) -m fiplib figures claims
	@mv $@.begun $@

.PHONY: absent
absent:
$(FIGURE_FILES): .make/figures ;
$(GALLERY_FILES): .make/gallery ;
$(CLAIM_FILES): .make/claims ;

# --- bags. They are data: nothing records one but `make bags`, or a `fly-` target by name.
.PHONY: $(FLIGHTS)
$(FLIGHTS): fly-%: .venv/installed
	$(PY) -m fiplib fly --scenario $* --output data/$* --force

data/sweeps/%.csv:
	@echo "$@ is missing. It comes with the repository; make sweep STUDIES=$* computes it again." >&2; exit 1

data/%:
	@echo "$@ is missing. Bags come with the repository; 'make bags' flies and records them again." >&2; exit 1


# --- paper. A fixed date makes the PDF depend on its sources alone. latexmk decides by content, make by time: the touch
# reconciles them.
paper/build/main.pdf: $(wildcard paper/*.tex paper/sections/*.tex paper/*.bib) $(FIGURE_FILES) $(CLAIM_FILES) | latex
	cd paper && SOURCE_DATE_EPOCH=1767225600 FORCE_SOURCE_DATE=1 \
	    latexmk -pdf -interaction=nonstopmode -halt-on-error -outdir=build main.tex
	@touch $@
