# The commands of the project. `make demo` installs what the program needs; `make test` and `make lint` the tools on top.
# The Python to install with; found by .ci/find-python where it is not given.
PYTHON ?=
BIN := .venv/bin
READY := .venv/.installed
TOOLS := .venv/.installed-dev
NETWORKS := .venv/.installed-grounded
TORCH := torch==2.13.0
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
# Some machines forbid byte code; the tests start hundreds of processes, which would all compile the program anew.
export PYTHONDONTWRITEBYTECODE =

.PHONY: demo demo-site test test-all test-drawn test-postgres test-realtime test-whole test-sweeps test-versions marks lint format docs reference bench mutants torture-audit torture-crash torture-faults torture-fuzz soak lock clean

demo: $(READY)
	$(BIN)/orthocapture demo

# The same on a whole site, whose servers all run on this machine: needs Debian's PostgreSQL (docs/howto/site.md).
demo-site: $(TOOLS)
	$(BIN)/python -m bench.whole_runs.demo_site

# Units, wires and one short run, in minutes; nothing of it needs more than Python and what pip installs. All tests of
# tests/browser do need more, and are not even read.
test: $(TOOLS)
	$(BIN)/pytest -m "not (slow or realtime or packages or whole or sweep)" --ignore=tests/browser

# All tests: those that meet the clock run after the others, two at a time, for they wait most of theirs.
test-all: $(TOOLS) $(NETWORKS)
	.ci/packages
	$(BIN)/pytest -m "not realtime"
	$(BIN)/pytest -m realtime -n 2 $(call with,realtime)

# What `make test` leaves out, but for the tests that meet the clock, with a tenth of the whole runs and sweeps: SEED
# draws them.
SEED = $(shell git rev-parse HEAD)
test-drawn: $(TOOLS) $(NETWORKS)
	.ci/packages
	$(BIN)/pytest -m "(slow or packages or whole or sweep) and not realtime" --draw $(SEED) $(call with,slow|packages|whole|sweep) tests/browser
	$(BIN)/pytest --database postgresql tests/store/test_store_*.py

# The tests of the record on PostgreSQL (tests/plugins/database.py); `make test-drawn` runs those of the chains, jobs,
# crashes and races there.
ON_POSTGRES = $(addprefix tests/, audit objects people recovery rig run server steps store verify web)
test-postgres: $(TOOLS)
	.ci/packages
	$(BIN)/pytest --database postgresql -m "not (realtime or whole or sweep)" $(ON_POSTGRES)

# The tests that meet the clock, with nothing else: two at a time, for they wait most of theirs. Beside much more than that
# none fails by chance (bench/suite/realtime.py).
test-realtime: $(TOOLS)
	$(BIN)/pytest -m realtime -n 2 $(call with,realtime)

# The test files in which one of these marks stands: to read all of the others takes pytest half a minute.
with = $$(grep -rlwE '$(1)' tests --include='test_*.py')

# Every whole run; every row of every systematic sweep.
test-whole test-sweeps: $(TOOLS) $(NETWORKS)
	.ci/packages
	$(BIN)/pytest -m $(subst test-sweeps,sweep,$(subst test-whole,whole,$@))

# Measures what each test costs, or those of FILES, and renews the marks `slow` and the list tests/cpu_seconds.json.
marks: $(TOOLS) $(NETWORKS)
	.ci/packages
	rm -rf build/cpu
	$(BIN)/pytest $(or $(FILES),tests) -m "not whole" --cpu-record=build/cpu
	$(BIN)/python -m bench.suite.marks build/cpu
	$(BIN)/ruff check --fix --quiet tests
	$(BIN)/ruff format --quiet tests

# Installs the locks under every supported Python of this machine and runs the fast tests there.
test-versions:
	.ci/versions

lint: $(TOOLS)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports
	$(BIN)/python -m bench.suite.dialect --check
	$(BIN)/python -m bench.suite.marks --check

format: $(TOOLS)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The pages of docs/reference that are made from the code, but for faults.md (make torture-faults).
reference: $(TOOLS)
	$(BIN)/python -m docs.generate

# The site in build/docs; a warning is an error.
docs: $(TOOLS)
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going docs build/docs

# Measurements that take long; each is a script of its own and writes to bench/results.
bench: $(TOOLS)
	$(BIN)/python -m bench.whole_runs.demo_accuracy
	$(BIN)/python -m bench.registration.accuracy
	$(BIN)/python -m bench.markers.marker_speed
	$(BIN)/python -m bench.registration.register_scale
	$(BIN)/python -m bench.pixels.pixel_depth

# Bad input for every parser: so many seconds for each (an hour: make torture-fuzz FUZZ_S=3600). What is found is kept in
# build/fuzz. With `$(BIN)/python -m pip install ".[fuzz]"` a second engine follows the lines that an input reaches.
FUZZ_S = 60
torture-fuzz: $(TOOLS)
	$(BIN)/python -m bench.torture.fuzz --seconds-per-target $(FUZZ_S) --record

# Every byte, row, roll-back and forgery of a small record: hours. MINUTES=60 ends it early, WORK=DIR goes on with it.
torture-audit: $(TOOLS)
	$(strip $(BIN)/python -m bench.torture.audit $(if $(MINUTES),--minutes $(MINUTES)) $(if $(WORK),--work $(WORK)))

# Small faults in the places that matter, drawn by SEED: does a test notice each? What survives is listed.
COUNT = 300
AT_LEAST = 0
mutants: $(TOOLS)
	$(BIN)/python -m bench.suite.mutants --seed $(SEED) --count $(COUNT) --at-least $(AT_LEAST)

# Searches for faults that no single test looks for (docs/howto/torture.md); takes most of an hour.
torture-crash: $(TOOLS)
	$(BIN)/python -m bench.torture.crash

# Every message of every wire spoilt in every way, and what devices and disks do by themselves (docs/reference/faults.md): hours.
# MINUTES=30 ends it early; ONLY='robot/rtde/*' chooses. What differs from the table is told.
torture-faults: $(TOOLS)
	$(strip $(BIN)/python -m bench.torture.faults $(if $(ONLY),--only '$(ONLY)') $(if $(MINUTES),--minutes $(MINUTES)))

# Long and large (docs/howto/soak.md): an hour of captures, a run of 10,000 viewpoints, many on one file, speed. Hours.
soak: $(TOOLS)
	$(BIN)/python -m bench.soak

# New locks: needs uv (pip install uv). The second holds the first and the tools of tests and lint. The third has no
# huggingface-hub 2: it brings httpx2, which the tests' web client would then use instead of httpx.
COMPILE = uv pip compile --universal --generate-hashes --no-emit-index-url --no-annotate --no-header \
	--python-version 3.11 --group build pyproject.toml
lock:
	$(COMPILE) -o .ci/constraints.txt
	$(COMPILE) --extra dev --constraint .ci/constraints.txt -o .ci/constraints-dev.txt
	echo 'transformers huggingface-hub<2 sympy networkx filelock fsspec jinja2 typing-extensions' | tr ' ' '\n' | \
		$(subst --group build pyproject.toml,--constraint .ci/constraints-dev.txt -,$(COMPILE)) -o .ci/constraints-grounded.txt
	sed -i '1i # Locked versions and hashes of what the detector grounded needs beside PyTorch; made by `make lock`.' \
		.ci/constraints-grounded.txt
	sed -i '1i # Locked versions and hashes of everything that orthocapture needs; made by `make lock`.' .ci/constraints.txt
	sed -i '1i # The same with the tools of tests and lint; made by `make lock`.' .ci/constraints-dev.txt

# Ready-made packages only: nothing is compiled on the way, and what has none for this Python is named at once. PyTorch
# has a file for newer Pythons alone, which older ones cannot compile.
$(READY): pyproject.toml .ci/constraints.txt
	test -x $(BIN)/python || { python="$(PYTHON)"; python="$${python:-$$(.ci/find-python)}" && "$$python" -m venv .venv; }
	$(BIN)/python -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14) and \
		"orthocapture runs on Python 3.11 to 3.13, not on %d.%d: make clean, then make" % sys.version_info[:2])'
	$(PIP) --no-compile --only-binary :all: --require-hashes -r .ci/constraints.txt
	$(PIP) --no-deps --no-build-isolation --editable .
	$(BIN)/python -m compileall -qq -j 0 -x '/include/|/tests/|/torch/testing/' .venv/lib service drivers simulators
	touch $(READY)

# jsonpath-rw, which mlcroissant needs, is published as a source archive alone: plain Python, built with our setuptools.
$(TOOLS): $(READY) .ci/constraints-dev.txt
	$(PIP) --no-compile --only-binary :all: --no-binary jsonpath-rw --no-build-isolation --require-hashes -r .ci/constraints-dev.txt
	$(BIN)/python -m compileall -qq -j 0 -x '/include/|/tests/|/torch/testing/' .venv/lib
	touch $(TOOLS)

# The packages of the detector `grounded`, for its tests: PyTorch without CUDA where the index has that build. Its hash
# depends on the build, so it is locked by its version alone.
$(NETWORKS): $(TOOLS) .ci/constraints-grounded.txt
	$(PIP) --no-compile --only-binary :all: --require-hashes -r .ci/constraints-grounded.txt
	$(PIP) --no-compile --no-deps "$(TORCH)+cpu" || $(PIP) --no-compile "$(TORCH)"
	touch $(NETWORKS)

clean:
	rm -rf .venv build *.egg-info
