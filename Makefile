# Each target does all of its own set-up, once, in a virtual environment of its own.

VENV := .venv
LOWEST := .venv-lowest
AUDIT := .venv-audit
FUZZ_SECONDS ?= 30
SEQUENCE ?=
FRAMES ?= 21
REAL_FRAMES ?=
ONLY ?=
TABLES ?= dds soak outvoted links loops 'live loops' 'camera height' 'short ways' coverage
SEEDS ?= 0,1,2,3,4
# linters and tests share an environment: each installation compiles the loops anew
TOOLS := $(VENV)/.installed-lint,peers,test
# what an installation is made of, beside what it finds in place
BUILT := setup.py $(wildcard djet_ros/compiled/*.[ch])
# one more than there are cores: tests that wait for processes would leave theirs idle
WORKERS ?= $(shell expr $$(nproc 2>/dev/null || getconf _NPROCESSORS_ONLN) + 1)
# in the order of their names: files of few tests, some of them long, would come last
PYTEST := python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder
# also where an older version is installed
NEWEST := pip install --quiet --upgrade --upgrade-strategy eager --editable

# the first that is there, works (a pyenv shim may not) and is new enough
PYTHON ?= $(shell for python in python3.12 python3.11 python3.13 python3; do \
	$$python -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' \
	2>/dev/null && echo $$python && break; done)

# Where this is set, as in many containers, every process that a test starts would compile all
# modules of the package anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test lint lowest fuzz audit results recorded pages installed installed-lowest \
	lowest-libraries clean

demo: $(VENV)/.installed
	$(VENV)/bin/djet demo $(if $(SEQUENCE),'$(SEQUENCE)') --output demo --overwrite

test: $(TOOLS)
	$(VENV)/bin/$(PYTEST)

lint: $(TOOLS)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/flake8
	$(VENV)/bin/mypy

# on the oldest versions that setup.py allows, the tests of what depends on them: numerics,
# compiled loops, decoding, bags, parameters, replay, live session; all others are marked slow
lowest: $(LOWEST)/.installed-test
	$(LOWEST)/bin/$(PYTEST) -m 'not slow'

# the environments alone, for .ci/run
installed: $(TOOLS)
installed-lowest: $(LOWEST)/.installed-test
lowest-libraries: $(LOWEST)/.libraries

# everything that reads what strangers made, for FUZZ_SECONDS each
fuzz: $(VENV)/.installed-fuzz
	$(VENV)/bin/python test/fuzz.py --seconds $(FUZZ_SECONDS)

# known vulnerabilities in the newest versions that setup.py allows, the extras' too; apart those
# that slam allows, whose GTSAM needs NumPy 1 and with it an older OpenCV
audit: $(AUDIT)/bin/pip $(AUDIT)-slam/bin/pip
	$(AUDIT)/bin/$(NEWEST) '.[audit,cluster,dds,peers]'
	$(AUDIT)/bin/python .ci/audit.py
	$(AUDIT)-slam/bin/$(NEWEST) '.[audit,slam]'
	$(AUDIT)-slam/bin/python .ci/audit.py

# the figures of doc/results.md and the README's table; a broken run is taken up where it ended;
# ONLY adds parts to what the same settings and code gave
results: $(TOOLS)
	$(VENV)/bin/python doc/measure.py --frames $(FRAMES) --seeds $(SEEDS) \
		$(if $(REAL_FRAMES),--real-frames $(REAL_FRAMES)) $(if $(ONLY),--only '$(ONLY)')
	$(VENV)/bin/python doc/pages.py

# tables beside those: TABLES of node, dds, soak, outvoted, links, loops, 'live loops',
# 'camera height', 'short ways' and coverage
recorded: $(TOOLS)
	$(VENV)/bin/python doc/record.py $(TABLES)
	$(VENV)/bin/python doc/pages.py

# what stands between generated marks in the README and in doc/
pages: $(TOOLS)
	$(VENV)/bin/python doc/pages.py

clean:
	rm -rf $(VENV) $(LOWEST) $(AUDIT) $(AUDIT)-slam build demo fuzz *.egg-info djet_ros/compiled/*.so

$(VENV)/.installed: $(BUILT) | $(VENV)/bin/pip
	$(VENV)/bin/pip install --quiet --editable .
	touch $@

# Python compiles what the tests import as they do, a fifth of what is installed.
$(VENV)/.installed-%: $(BUILT) | $(VENV)/bin/pip
	$(VENV)/bin/pip install --quiet --no-compile --editable '.[$*]'
	touch $@

$(LOWEST)/.libraries: test/lowest.txt | $(LOWEST)/bin/pip
	$(LOWEST)/bin/pip install --quiet --no-compile --requirement test/lowest.txt
	touch $@

$(LOWEST)/.installed-test: $(BUILT) $(LOWEST)/.libraries
	$(LOWEST)/bin/pip install --quiet --no-compile --editable '.[test]' \
		--constraint test/lowest.txt
	touch $@

%/bin/pip:
	@test -n '$(PYTHON)' || { echo 'make: error: Python 3.11 or newer with venv is needed' \
		'(Ubuntu: sudo apt install python3-venv)' >&2; exit 1; }
	@echo 'Setting up $* (once) ...'
	$(PYTHON) -m venv $*
