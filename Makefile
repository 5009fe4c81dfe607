# Every task of the project; `make` alone lists them. A task sets up what it needs: Python 3.11 or newer and make are
# enough. Packages go to .venv, at the versions in requirements.lock, and nothing else is downloaded (but by `make data`).
# Names of files and values from outside reach a shell as variables of the environment or not at all, never as its text.

PYTHON ?= python3
JOBS ?= 2
export PYTHON JOBS
unexport PYTHONHOME

# One make at a time in a checkout: the first one takes its lock and calls another, which has the tasks.
# But JupyterLab, which is open for as long as somebody works in it.
ifneq ($(filter-out help lab,$(MAKECMDGOALS)),)
ifneq ($(value DBTHERMAL_LOCKED),$(CURDIR))
unlocked := yes
endif
endif

ifdef unlocked
export GOALS := $(MAKECMDGOALS)
.PHONY: under-lock $(MAKECMDGOALS)
$(MAKECMDGOALS): under-lock ; @:
under-lock:
	+@"$$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { printf "Invalid Python '%s'. Must be 3.11 or newer: make PYTHON=python3.12\n" "$$PYTHON" >&2; exit 1; }; \
	    exec "$$PYTHON" -I notebooks/reproduction/locked.py "$(MAKE)" "$$PPID"
else

python := .venv/bin/python
plainly := -not -path '*[!A-Za-z0-9._/-]*' 2>/dev/null | LC_ALL=C sort
stems := $(basename $(notdir $(shell LC_ALL=C find notebooks -maxdepth 1 -name '[0-9][0-9]_*.ipynb' $(plainly))))
full := $(stems:%=results/full/%.ipynb)
recorded := $(basename $(notdir $(shell LC_ALL=C find params/recorded -name '*.yaml' $(plainly))))
rig := $(recorded:%=results/rig/%.ipynb)
# The long ones start first, but for those that would compile what 00_quickstart compiles at the same time. Make puts one off to the end
# that still waits for another when its turn comes: so a short one stands between.
early := full/00_acquisition full/00_quickstart full/01_calibration full/02_emissivity full/07_bench full/03_simulation full/08_twins \
    full/04_separation full/05_methods rig/01_calibration full/10_limits full/14_live rig/04_separation full/13_whole full/06_optimiser \
    full/12_published
smoke := $(stems:%=results/smoke/%.ipynb)
sources := $(shell LC_ALL=C find dbthermal notebooks/reproduction -type f -not -path '*/__pycache__/*' $(plainly)) $(wildcard data_manifest.yaml)
execute = @$(python) -m reproduction.execute
compile = $(python) -m uv pip compile --quiet --universal --python-version 3.11 --fork-strategy fewest --all-extras \
    --group lock --no-annotate --no-emit-index-url --no-emit-find-links --custom-compile-command 'make lock'
parallel := $(MAKE) --no-print-directory --jobs="$$JOBS" $(if $(filter output-sync,$(.FEATURES)),--output-sync=target)

# A mirror of the outside files is named from here, but read from the notebooks' folder too.
override DBTHERMAL_DATA := $(value DBTHERMAL_MIRROR)
export DBTHERMAL_DATA

# The same warnings, threads and settings on every machine, in this process and in the notebooks' kernels. One thread per
# linear-algebra call, for the order of a sum must not hang on the number of cores; a user's own settings stay out of it.
export PYTHONWARNINGS := error::RuntimeWarning
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
export MKL_NUM_THREADS ?= 1
export IPYTHONDIR := $(CURDIR)/.venv/share/ipython
export JUPYTER_CONFIG_DIR := $(CURDIR)/.venv/etc/jupyter
export JUPYTER_DATA_DIR := $(CURDIR)/.venv/share/jupyter
export MPLCONFIGDIR := $(CURDIR)/.venv/share/matplotlib
export PIP_DISABLE_PIP_VERSION_CHECK := 1
unexport JUPYTER_PATH MPLBACKEND
export PYTHONPATH := $(CURDIR)/notebooks

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help install format check types pytest smoke chain interop test test-slow test-long reproduce full verify record data docs lab bench attack lock clean FORCE

help: ## list the tasks
	@awk 'BEGIN { FS = ":.*## " } /^[a-z-]+:.*## / { printf "make %-10s %s\n", $$1, $$2 }' Makefile

install: .venv/installed ## set up the environment in .venv

format: .venv/installed ## format the code and mend what the linter can mend
	$(python) -m ruff format
	$(python) -m ruff check --fix

check: .venv/installed ## lint, without changing a file
	$(python) -m ruff format --check
	$(python) -m ruff check

types: .venv/installed ## check the types
	$(python) -m mypy

pytest: .venv/installed ## run the tests alone
	$(python) -m pytest --numprocesses="$$JOBS"

smoke: $(smoke) ## run every notebook with its own small values, as a test

chain: $(recorded:%=results/chain/%.ipynb) ## from the bytes of the emulated rig to its separated video, with small values

interop: ## compare emulators and codecs with independent software, in an environment of its own, which it downloads
	"$$PYTHON" -m venv --clear .venv/interop
	PIP_CONSTRAINT=requirements.lock .venv/interop/bin/python -m pip install --quiet pip
	.venv/interop/bin/python -m pip install --quiet --group interop --editable '.[instruments,test]'
	.venv/interop/bin/python -c "import flirpy, thorlabs_apt_protocol"
	.venv/interop/bin/python -m pytest tests/instruments/test_interop.py

test: .venv/installed ## check lint, types, the quick tests, and every notebook with small values
	$(parallel) check types
	$(MAKE) --no-print-directory pytest
	$(parallel) smoke

test-slow: .venv/documenting ## run the long tests, and the notebooks on the recordings of the emulated rig
	$(python) -m pytest --numprocesses="$$JOBS" -m 'slow and not long'
	$(parallel) chain

test-long: .venv/installed ## run the long counts, for which nobody waits: many seeds, every kind of kill
	$(python) -m pytest --numprocesses="$$JOBS" -m long

# A process keeps the memory that it has freed, in one heap for all threads (GNU's C library; others ignore this): the arrays of
# films are made anew so often that clearing their pages takes half of all the time spent in the system otherwise.
reproduce: export MALLOC_ARENA_MAX := 1
reproduce: export MALLOC_MMAP_MAX_ := 0
reproduce: export MALLOC_TRIM_THRESHOLD_ := 17179869184
reproduce: .venv/installed ## run the notebooks with the values in params/, into results/full
	@$(python) -m reproduction.integrity full rig
	@$(python) -m reproduction.methods
	$(parallel) full

full: $(foreach one,$(early),$(filter results/$(one).ipynb,$(full) $(rig))) $(full) $(rig)

verify: .venv/installed ## compare results/full with the stored reference numbers
	$(python) -m reproduction.verify

record: .venv/installed ## keep the numbers of results/full as the reference, and its scene as the picture in the README
	$(python) -m reproduction.verify --record
	cp results/full/04_separation_twin.png notebooks/separated_scene.png

data: .venv/installed ## fetch the outside files that data_manifest.yaml lists
	$(python) -m reproduction.manifest

docs: .venv/documenting ## build the documentation site into results/docs/html, with the notebooks that are in results/full
	$(python) -m sphinx --fail-on-warning --keep-going --fresh-env --quiet docs results/docs/html

lab: ## open JupyterLab on a copy of the five-minute tour, in results/lab
	@$(MAKE) --no-print-directory install
	@test -e results/lab/tour.ipynb || { mkdir -p results/lab && cp notebooks/00_quickstart.ipynb results/lab/tour.ipynb; }
	$(python) -m jupyterlab results/lab/tour.ipynb

bench: .venv/installed ## measure the default call, every method, and a run from disk to disk, into results/bench
	$(python) -m reproduction.benchmark

attack: .venv/installed ## attack the package with 6,000 hostile inputs, and write their counts into docs/attack.md
	PYTHONPATH=tests:notebooks $(python) -m attack --inputs 6000 --seed 900001 --write docs/attack.md

lock: .venv/installed ## write both locks anew from pyproject.toml, keeping the pins that still fit
	PIP_CONSTRAINT=requirements.lock $(python) -m pip install --quiet uv
	$(compile) --output-file requirements.lock pyproject.toml
	$(compile) --no-config --generate-hashes --constraint requirements.lock --output-file requirements-hashes.lock pyproject.toml

clean: ## remove all that make made: results, environment, caches
	rm -rf results docs/api docs/notebooks .venv .venv-interrupted .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find dbthermal tests notebooks -name __pycache__ -prune -exec rm -rf {} +

# The lock constrains the package's own build too; pip renamed the variable for that. One in which an install fails, as without a
# network, is as it was. What one that was interrupted left may look whole to pip: it is put aside, and goes when a new one is whole.
.venv/installed: pyproject.toml requirements.lock
	@trap 'exit 130' HUP INT TERM; \
	if test -e .venv/installing; then \
	    if test -e .venv-interrupted; then rm -rf .venv; else mv .venv .venv-interrupted; fi; \
	fi; \
	mkdir -p .venv; whole=; if test -e $@; then whole=yes; mv $@ .venv/installing; else touch .venv/installing; fi; \
	export PIP_CONSTRAINT=requirements.lock; \
	if "$$PYTHON" -m venv .venv && $(python) -m pip install --quiet pip && PIP_BUILD_CONSTRAINT=requirements.lock \
	    $(python) -m pip install --quiet --editable '.[notebooks,test]'; then \
	    sync && touch .venv/installing && mv .venv/installing $@ && rm -rf .venv-interrupted; \
	else \
	    if test -e .venv-interrupted; then rm -rf .venv; mv .venv-interrupted .venv; \
	    elif test "$$whole"; then mv .venv/installing $@; else rm -f .venv/installing; fi; \
	    echo "The environment .venv is not up to date, and as it was: see above. It is made by 'make install'." >&2; exit 1; \
	fi

# What the site needs; an environment in which this is interrupted counts as interrupted, and one in which it fails is as it was.
.venv/documenting: .venv/installed
	@mv .venv/installed .venv/installing
	PIP_CONSTRAINT=requirements.lock PIP_BUILD_CONSTRAINT=requirements.lock \
	    $(python) -m pip install --quiet --editable '.[docs]' || { mv .venv/installing .venv/installed; exit 1; }
	@sync && mv .venv/installing .venv/installed && touch $@

# Which outside files there are changes the results, so a change of theirs counts as a change of a source.
listed := { printf 'DBTHERMAL_DATA=%s\n' "$$DBTHERMAL_DATA"; find -L data -type f 2>/dev/null | LC_ALL=C sort; }
ifneq ($(shell $(listed) | cmp -s - results/inputs.txt || echo changed),)
results/inputs.txt: FORCE
endif
results/inputs.txt:
	@mkdir -p $(@D) && $(listed) > $@

# The executed notebook stands for all that it writes: a folder's own time does not change with its content. It has its
# name only when it is whole; one that fails is kept in results/failed, to be read, and leaves nothing that looks whole.
results/full/%.ipynb: notebooks/%.ipynb params/%.yaml $(sources) results/inputs.txt .venv/installed
	$(execute) full $* -f params/$*.yaml

results/smoke/%.ipynb: notebooks/%.ipynb $(sources) results/inputs.txt .venv/installed
	$(execute) smoke $* --check

# The same notebooks on what the emulated rig recorded: full values in results/rig, small ones in results/chain.
results/rig/%.ipynb: notebooks/%.ipynb params/%.yaml params/recorded/%.yaml results/full/00_acquisition.ipynb
	$(execute) rig $* -f params/$*.yaml -f params/recorded/$*.yaml -p recorded results/full/00_acquisition

results/chain/%.ipynb: notebooks/%.ipynb params/recorded/%.yaml results/smoke/00_acquisition.ipynb
	$(execute) chain $* -f params/recorded/$*.yaml -p recorded results/smoke/00_acquisition

# The notebooks that open what another one saved; the last of them reads the numbers of all.
calibrated := 02_emissivity 04_separation
paper := 09_paper
$(calibrated:%=results/full/%.ipynb): results/full/01_calibration.ipynb
$(calibrated:%=results/smoke/%.ipynb): results/smoke/01_calibration.ipynb
$(paper:%=results/full/%.ipynb): $(filter-out $(paper:%=results/full/%.ipynb),$(full))
$(paper:%=results/smoke/%.ipynb): $(filter-out $(paper:%=results/smoke/%.ipynb),$(smoke))
results/rig/02_emissivity.ipynb results/rig/04_separation.ipynb: results/rig/01_calibration.ipynb
results/chain/02_emissivity.ipynb results/chain/04_separation.ipynb: results/chain/01_calibration.ipynb

endif
