PYTHON ?= python3
VENV := .venv
# Where an environment's programs are: on Windows make needs Git's sh in the path.
BIN := $(if $(filter Windows_NT,$(OS)),Scripts,bin)
RUN := $(VENV)/$(BIN)/python
# Threads that spin while they wait slow each other down where other work is running.
export OMP_WAIT_POLICY ?= PASSIVE
STAMP := $(VENV)/.installed

.PHONY: demo test test-blender test-cluster bench fuzz lint style types imports licences docs gallery app clean

# Bytecode is written of what is imported, a quarter of all: compiling the rest takes longer than installing it.
INSTALL := $(RUN) -m pip install --quiet --no-compile --constraint constraints.txt --editable

$(VENV)/.made:
	$(PYTHON) -m venv $(VENV)
	touch $@

$(STAMP): $(VENV)/.made pyproject.toml constraints.txt
	@echo "installing into $(VENV), a few minutes"
	$(INSTALL) .
	touch $@

# Each has what tests need, too. What tests import is compiled once, before several processes do it at the same time.
$(VENV)/.installed-%: $(VENV)/.made pyproject.toml constraints.txt
	@echo "installing torchface and what '$*' needs into $(VENV), a few minutes"
	$(INSTALL) '.[test,$*]'
	PYTHONDONTWRITEBYTECODE= $(RUN) -c 'import matplotlib.pyplot, onnxscript.optimizer, sklearn.svm, torch._dynamo, torch.onnx, trimesh'
	touch $(STAMP) $(VENV)/.installed-test $@

# Three processes of one thread each for two cores, as browsers and programs are waited for; the longest files first, and what is
# costly to make once (a synthetic video, a browser) stays in one.
# Bytecode is written, whatever the shell says: many tests start a process. glibc keeps freed memory: else each large tensor is
# asked of the system anew, a tenth of the time.
test: $(VENV)/.installed-test
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 MALLOC_MMAP_THRESHOLD_=1073741824 MALLOC_TRIM_THRESHOLD_=4294967296 \
		$(RUN) -m pytest --numprocesses 3 --dist loadfile --no-loadscope-reorder

# Blender's package has a Python of its own: it wants 3.11 and numpy below 2.
BLENDER_PYTHON ?= python3.11
BLENDER := .venv-blender
$(BLENDER)/.installed: constraints.txt
	@echo "installing Blender into $(BLENDER), 400 MB"
	$(BLENDER_PYTHON) -m venv $(BLENDER)
	$(BLENDER)/$(BIN)/python -m pip install --quiet --constraint constraints.txt bpy
	touch $@

test-blender: $(VENV)/.installed-test $(BLENDER)/.installed
	TORCHFACE_BLENDER=$(BLENDER)/$(BIN)/python $(RUN) -m pytest -m blender tests/io/blender

# Ray starts a cluster of two nodes on this machine; should it hang, the time limit ends it, and all its processes.
test-cluster: $(VENV)/.installed-cluster
	RAY_USAGE_STATS_ENABLED=0 OMP_NUM_THREADS=1 timeout --kill-after=30 900 $(RUN) -m pytest -m cluster -o faulthandler_timeout=300 \
		tests/workflows/batch

bench: $(VENV)/.installed-bench
	$(RUN) -m pytest tests/benchmarks -s
	$(RUN) -m pytest -m bench
	$(RUN) docs/quote_figures.py

fuzz: $(VENV)/.installed-test
	TORCHFACE_FUZZ_CASES=10000 $(RUN) -m pytest tests/io -k 'mutated or built'

# Each check is a target of its own; .pre-commit-config.yaml runs the same.
lint: style types imports licences

style: $(VENV)/.installed-lint
	$(VENV)/$(BIN)/ruff check .
	$(VENV)/$(BIN)/ruff format --check .

types: $(VENV)/.installed-lint
	$(VENV)/$(BIN)/mypy

imports: $(VENV)/.installed-lint
	$(VENV)/$(BIN)/lint-imports

licences: $(VENV)/.installed-lint
	$(VENV)/$(BIN)/pip-licenses --output-file $(VENV)/licences.txt
	$(RUN) -m pytest -q tests/test_licences.py

# Tutorials run on the first build and when they change; a warning is an error.
docs: $(VENV)/.installed-docs
	OMP_NUM_THREADS=2 $(RUN) -m sphinx -W --keep-going -d out/docs_doctrees docs out/docs
	@echo "open out/docs/index.html"

# The pictures of docs/how_to/gallery.md: characters by code, rigged.
gallery: $(VENV)/.installed-test
	PYTHONPATH=.:tests $(RUN) docs/make_gallery.py

demo: $(STAMP)
	$(VENV)/$(BIN)/torchface demo $(if $(TEMPLATE),--template "$(TEMPLATE)") $(if $(TAKE),--take "$(TAKE)") $(if $(TARGET),--target "$(TARGET)")

# The browser app's page, for a wheel whose users need no Node; `torchface export app` builds it by itself elsewhere.
app:
	cd export/web && npm ci --ignore-scripts --no-audit --no-fund && npx vite build --emptyOutDir --outDir ../../torchface/_app/dist

clean:
	rm -rf $(VENV) $(BLENDER) out torchface/_app
