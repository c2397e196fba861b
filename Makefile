# The commands of the project; `make demo` and `make test` need nothing but Python 3.11+.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.installed
# Some machines forbid byte code; the tests start hundreds of processes, which would all compile the program anew.
export PYTHONDONTWRITEBYTECODE =

.PHONY: demo test lint format docs bench lock clean

demo: $(READY)
	$(BIN)/orthocapture demo

test: $(READY)
	$(BIN)/pytest

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --threads 2
	$(BIN)/lint-imports

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# What docs/ holds that is made from the code: protocol schema and state diagram.
docs: $(READY)
	$(BIN)/orthocapture protocol schema > docs/protocol.schema.json
	$(BIN)/orthocapture protocol diagram protocols/exvivo_spine.yaml > docs/state_machine.md

# Measurements that take long; each is a script of its own and writes to bench/results.
bench: $(READY)
	$(BIN)/python -m bench.demo_accuracy
	$(BIN)/python -m bench.accuracy
	$(BIN)/python -m bench.marker_speed
	$(BIN)/python -m bench.register_scale

# A new lock: needs uv (pip install uv).
lock:
	uv pip compile --universal --generate-hashes --no-emit-index-url --no-annotate --no-header \
		--python-version 3.11 pyproject.toml --extra dev -o constraints.txt
	sed -i '1i # Locked versions and hashes of everything orthocapture installs; made by `make lock`.' constraints.txt

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "orthocapture needs Python 3.11 or newer; say which: make PYTHON=python3.12")'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check --require-hashes -r constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	$(BIN)/python -m compileall -qq -j 0 -x '/include/' .venv/lib service drivers simulators
	touch $(READY)

clean:
	rm -rf .venv build *.egg-info
