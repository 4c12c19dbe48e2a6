# make eval_report   install, then the whole pipeline on the miniature: results/mini/eval/report.html
# make dry-run       install, then the plan of the miniature: its jobs, none of which runs
# make test          install, then format, lint, types and tests, a real run of the reduced miniature among them
# make docs         the site of the documentation: site/index.html
# make audit         known vulnerabilities of the pinned packages, from a service: needs the network
# make test-faults   kills of the workflow, 10,000 damaged files, determinism of results: the slow tests of tests/faults
# make test-live     what the code needs of IGN's services: needs the network
# make test-wheel    the wheel in an empty environment, from its installation to a page of buildings
# make test-slurm    the reduced miniature on a Slurm of this machine alone; as root, with Debian's packages of Slurm
PYTHON ?= python3
BIN := .venv/bin
INSTALLED := $(BIN)/.installed
CORES ?= 2
# many small tensors on few cores: OpenMP threads that spin while they wait make torch 40 times slower
export OMP_WAIT_POLICY := PASSIVE
export GOMP_SPINCOUNT := 0
export PATH := $(CURDIR)/$(BIN):$(PATH)

.PHONY: install engines eval_report dry-run test test-geometry test-network test-others test-workflow test-slow test-faults test-live test-slurm test-wheel docs lint audit format config mini lock clean
install: $(INSTALLED)
	$(BIN)/p2wss warm-up --all

# --no-compile, as most modules of the packages are never imported: the first start of a command compiles those that are
# (1.6 CPU seconds), and keeps them, since .venv can be written to
$(INSTALLED): envs/lock.txt pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -r envs/lock.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $@

# plugins of Slurm, Kubernetes and object storage, and what their tests need
engines: install
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r envs/engines.txt

eval_report: install
	snakemake -c$(CORES) eval_report

dry-run: $(INSTALLED)
	snakemake eval_report --dry-run --quiet rules

# two at a time, as most of the tests use one core; what they need is compiled beside lint
test: $(INSTALLED)
	$(MAKE) --jobs=2 --output-sync=target lint test-geometry test-workflow test-network test-others

GEOMETRY := $(addprefix tests/unit/,fit footprints mesh reconstruction skeleton)
NETWORK := $(addprefix tests/unit/,crops eval nets scans scenes towns training)

test-geometry: install
	pytest --durations=15 $(GEOMETRY)

test-network: install
	pytest --durations=15 $(NETWORK)

test-others: install
	pytest --durations=15 tests/unit $(patsubst %,--ignore=%,$(GEOMETRY) $(NETWORK))

test-workflow: install
	pytest --durations=15 tests/faults tests/workflow

test-slow: install
	pytest -m slow --timeout 3600

test-faults: install
	pytest -m slow --timeout 7200 tests/faults

# what the code needs of IGN's services, of which one may change any day
test-live: install
	pytest -m live tests/unit/fetching

# the wheel in an empty environment, up to a page of buildings: needs a package index
test-wheel: install
	$(BIN)/python benchmarks/wheel.py

test-slurm: engines
	pytest -m slow --timeout 3600 -s tests/workflow/test_slurm.py

# the site in site/, which needs neither the extras nor compiled code
docs:
	$(PYTHON) -m venv .venv-docs
	.venv-docs/bin/python -m pip install --quiet --disable-pip-version-check --no-compile --editable . 'mkdocs-material>=9.6'
	NO_MKDOCS_2_WARNING=1 .venv-docs/bin/mkdocs build --quiet

lint: $(INSTALLED)
	ruff check .
	ruff format --check .
	mypy
	snakefmt --check Snakefile workflow
	snakemake --lint
	bandit --quiet --severity-level medium --recursive src workflow

# known vulnerabilities of the packages in envs/lock.txt, from the JSON API of PyPI: needs the network; --strict, because
# without it a package that the service does not know counts as checked
audit: install
	$(BIN)/python -m pip install --quiet pip-audit
	$(BIN)/pip-audit --strict --requirement envs/lock.txt --no-deps --disable-pip

format: install
	ruff check --fix .
	ruff format .
	snakefmt Snakefile workflow

# the generated files of config/, from src/p2wss/config.py
config: install
	$(BIN)/python -m p2wss.config

# the files of tests/mini and of p2wss demo
mini: install
	$(BIN)/python benchmarks/towns.py --kind streets --seed 652 --out tests/mini --lidar
	cd benchmarks && ../$(BIN)/python -c "from pathlib import Path; import drawn_towns.files as f; f.write_demo(Path('../src/p2wss/cli/assets'))"

# newest versions that resolve together, within envs/constraints.txt
lock:
	$(BIN)/python -m pip install --quiet pip-tools
	$(BIN)/pip-compile --quiet --upgrade --allow-unsafe --strip-extras --no-emit-find-links --no-emit-index-url \
		--no-emit-options --no-header --extra workflow --extra test --extra lint -c envs/constraints.txt -o envs/lock.txt pyproject.toml
	sed -i -e 's/^torch==\([0-9.]*\)+.*/torch==\1/' envs/lock.txt
	$(BIN)/pip-compile --quiet --upgrade --allow-unsafe --strip-extras --no-emit-find-links --no-emit-index-url \
		--no-emit-options --no-header --no-annotate -c envs/lock.txt -o envs/engines.txt envs/engines.in

clean:
	rm -rf results resources logs .snakemake
