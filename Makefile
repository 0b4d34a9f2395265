# The whole path from recorded flights to figures, tests and paper. `make help` lists the targets.
# Written for GNU make 3.81 and later. Every product is a file target, so -j works and nothing is made twice.

PYTHON ?= python3
PY := .venv/bin/python

# The bytes of a flight must not depend on which newer kernels a CPU offers: one thread, and those of a 2013 x86-64.
# tests/conftest.py pins the same for a bare pytest.
export OPENBLAS_CORETYPE := Haswell
export OPENBLAS_NUM_THREADS := 1
export NPY_DISABLE_CPU_FEATURES := X86_V4 AVX512_ICL AVX512_SPR

# The bags that each figure and table reads; the same list as `python -m fiplib.reproduction.figures --list` (a test compares them).
reads_fig1-flight := circle-0.8
reads_fig2-vehicle :=
reads_fig3-pushes := push-hover
reads_fig4-circle := circle-0.8
reads_fig5-estimation := estimate-1.4
reads_fig6-convergence := estimate-0.8 estimate-1.2 estimate-1.4
reads_fig7-survival :=
reads_fig8-landscapes :=
reads_fig9-estimators :=
reads_fig10-intervals := estimate-1.4
reads_table1-parameters :=
reads_table2-software :=
reads_table3-convergence := estimate-0.8 estimate-1.2 estimate-1.4
reads_table4-estimators :=
reads_fig11-handover :=
reads_fig12-bound :=
reads_fig13-deadlines :=
reads_table5-seeds :=
reads_table6-readings :=
reads_table7-weights :=
reads_table8-handover :=
reads_table9-landscapes :=
reads_table10-rates :=
reads_table11-imperfections :=

# The tables of studies (`make sweep`) that some of them read, from data/sweeps/.
studies_fig7-survival := survival
studies_fig8-landscapes := landscape_curves
studies_fig9-estimators := estimators
studies_table4-estimators := estimators
studies_fig11-handover := handover
studies_fig12-bound := bounds
studies_table5-seeds := ledger_seeds
studies_table6-readings := ledger_seeds ledger_readings
studies_table7-weights := weights
studies_table8-handover := handover
studies_table9-landscapes := landscapes
studies_table11-imperfections := imperfections
studies_claims := ledger_seeds length_jumps estimators weights handover bounds imperfections

FIGURES := fig1-flight fig2-vehicle fig3-pushes fig4-circle fig5-estimation fig6-convergence fig7-survival fig8-landscapes fig9-estimators fig10-intervals fig11-handover fig12-bound fig13-deadlines
TABLES := table1-parameters table2-software table3-convergence table4-estimators table5-seeds table6-readings table7-weights table8-handover table9-landscapes table10-rates table11-imperfections
SCENARIOS := push-hover circle-0.8 estimate-0.8 estimate-1.2 estimate-1.4 length-jump

bag_files = $(foreach name,$(1),data/$(name)/$(name).mcap data/$(name)/metadata.yaml)
table_files = $(foreach name,$(1),data/sweeps/$(name).csv)
FIGURE_FILES := $(foreach name,$(FIGURES),figures/$(name).pdf figures/$(name).png)
TABLE_FILES := $(foreach name,$(TABLES),figures/$(name).csv figures/$(name).tex)
CLAIMS := figures/claims.csv figures/claims.txt paper/generated/numbers.tex paper/generated/claims-table.tex
FLIGHTS := $(SCENARIOS:%=fly-%)

# Whatever is computed is computed anew when the code or the pinned packages change.
CODE := $(shell find fiplib -name "*.py") requirements.lock

# What `make sweep` runs, and how: make sweep STUDIES='survival --limit 10'. One worker process per core; with
# DASK_SCHEDULER_ADDRESS=tcp://host:8786 in the environment, or on make's command line, the workers of that scheduler.
STUDIES := --all

LATEX_PACKAGES := texlive-latex-extra texlive-publishers texlive-science texlive-bibtex-extra latexmk cm-super

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.SUFFIXES:
MAKEFLAGS += --no-builtin-rules

.PHONY: help figures test notebooks lab book bags sweep bench paper latex lint clean

help: ## show this list
	@echo "make TARGET; every target sets up .venv by itself where it needs it"
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  %-9s  %s\n", $$1, $$2 }' Makefile

figures: $(FIGURE_FILES) $(TABLE_FILES) $(CLAIMS) ## make every figure and table of the paper, and print the claims ledger
	@cat figures/claims.txt

test: .venv/installed ## run the tests, and the notebooks with small settings, on every core
	@FIP_FAST=1 $(PY) -m pytest -n auto --dist loadgroup -m "not realtime" --nbmake notebooks tests; status=$$?; \
	    $(PY) -m pytest -m realtime tests && exit $$status

notebooks: .venv/installed ## run every notebook at full length; nothing is written into them
	@$(PY) -m pytest -n auto --nbmake --nbmake-timeout 3600 --verbose notebooks

lab: .venv/installed ## open JupyterLab on the first notebook
	$(PY) -m jupyterlab --LabApp.default_url=/lab/tree/notebooks/00-start-here.ipynb

book: .venv/installed ## make the book: notebooks with their results, and the library, docs/build/html
	@$(PY) docs/book.py

bags: $(FLIGHTS) ## fly the simulator again and rewrite data/ (one flight alone: make fly-circle-0.8)
	cd data && $(SHA256) $(foreach name,$(sort $(SCENARIOS)),$(name)/$(name).mcap $(name)/metadata.yaml) > SHA256SUMS

sweep: .venv/installed ## run the studies behind data/sweeps/, for hours; stop it any time, make sweep goes on from there
	$(PY) -m fiplib.studies.sweep $(STUDIES)

bench: .venv/installed ## time the controller, the estimator and a sweep
	@set -e; for script in benchmarks/*.py; do echo "$$script"; $(PY) "$$script"; done

paper: latex paper/build/main.pdf ## typeset the reproduction report, paper/build/main.pdf (needs LaTeX)
	@echo "The report is in paper/build/main.pdf"

latex: ## check for the LaTeX that the report needs, and say what to install
	@if ! command -v latexmk >/dev/null || ! kpsewhich elsarticle.cls siunitx.sty >/dev/null; then \
	    echo "The report needs LaTeX with latexmk. On Debian or Ubuntu:" >&2; \
	    echo "  sudo apt-get install $(LATEX_PACKAGES)" >&2; \
	    echo "Elsewhere: TeX Live or MacTeX in full. Figures and tests need none of it." >&2; \
	    exit 1; \
	fi

lint: .venv/installed ## check style, format and stripped notebooks
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(if $(wildcard notebooks/*.ipynb),$(PY) -m nbstripout --verify notebooks/*.ipynb)

clean: ## remove what was made; data/ and .venv stay
	rm -rf figures paper/build paper/generated docs/build .pytest_cache .ruff_cache .hypothesis
	find fiplib scripts tests benchmarks docs -name __pycache__ -exec rm -rf {} +

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
	@touch $@

# --- figures, tables, claims. A pattern rule with several targets is how make before 4.3 says that one command writes
# them all; the stem of the claims' rule has no meaning. Its place above the tables' rule matters to make 3.81.
figures/clai%s.csv figures/clai%s.txt paper/generated/nu%bers.tex paper/generated/clai%s-table.tex: $(CODE) | .venv/installed
	@mkdir -p figures paper/generated
	$(PY) -m fiplib.reproduction.ledger

figures/fig%.pdf figures/fig%.png: $(CODE) | .venv/installed
	@mkdir -p figures
	$(PY) -m fiplib.reproduction.figures fig$*

figures/table%.csv figures/table%.tex: $(CODE) | .venv/installed
	@mkdir -p figures
	$(PY) -m fiplib.reproduction.figures table$*

figures/table10-rates.csv figures/table10-rates.tex: benchmarks/sweep_rates.csv
figures/fig13-deadlines.pdf figures/fig13-deadlines.png: benchmarks/deadlines.csv
$(CLAIMS): $(call bag_files,$(SCENARIOS)) benchmarks/solve_times.csv benchmarks/deadlines.csv $(call table_files,$(studies_claims))
$(foreach name,$(FIGURES),$(eval figures/$(name).pdf figures/$(name).png: $(call bag_files,$(reads_$(name))) $(call table_files,$(studies_$(name)))))
$(foreach name,$(TABLES),$(eval figures/$(name).csv figures/$(name).tex: $(call bag_files,$(reads_$(name))) $(call table_files,$(studies_$(name)))))

# --- bags. They are data: nothing records one but `make bags`, or a `fly-` target by name.
.PHONY: $(FLIGHTS)
$(FLIGHTS): fly-%: .venv/installed
	$(PY) scripts/fly.py --scenario $* --output data/$* --force

data/sweeps/%.csv:
	@echo "$@ is missing. It comes with the repository; make sweep STUDIES=$* computes it again." >&2; exit 1

data/%:
	@echo "$@ is missing. Bags come with the repository; 'make bags' flies and records them again." >&2; exit 1

SHA256 = $(shell command -v sha256sum || echo shasum -a 256)

# --- paper. A fixed date makes the PDF depend on its sources alone. latexmk decides by content, make by time: the touch
# reconciles them.
paper/build/main.pdf: $(wildcard paper/*.tex paper/sections/*.tex paper/*.bib) $(FIGURE_FILES) $(TABLE_FILES) $(CLAIMS) | latex
	cd paper && SOURCE_DATE_EPOCH=1767225600 FORCE_SOURCE_DATE=1 \
	    latexmk -pdf -interaction=nonstopmode -halt-on-error -outdir=build main.tex
	@touch $@
