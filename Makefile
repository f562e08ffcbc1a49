# Everything runs in .venv, which the first target that needs it makes.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
INSTALL := $(PIP) install --quiet --no-compile -c constraints.txt
OUT := out/demo
# Tests start hundreds of processes: what one has parsed of the package, the next need not again,
# whatever the surroundings say.
export PYTHONDONTWRITEBYTECODE :=
SOLVE := $(BIN)/casadi-ik solve cup --scene table --log $(OUT)/cup.mcap --out $(OUT)/cup.json
PAPER := $(BIN)/casadi-ik solve cup --method enhanced-dls --log $(OUT)/cup_paper.mcap
SPHINX := $(BIN)/sphinx-build -E -q -W --keep-going -b html -c docs . out/docs \
  && $(BIN)/python docs/building/links.py out/docs

.PHONY: help demo test test-all lint docs page pictures bench notebooks clean

help:
	@echo "make demo       set up and solve the grasp of a real object, by our method and the paper's"
	@echo "make test       set up and run the tests, at most 5 minutes on two cores"
	@echo "make test-all   run the slow tests, which make test leaves out"
	@echo "make lint       style, names, types, layers, documentation"
	@echo "make docs       build the documentation site: out/docs/index.html"
	@echo "make page       build the page that solves in the browser: out/page/index.html"
	@echo "make pictures   draw the pictures of the documentation again"
	@echo "make bench      timings on this machine"
	@echo "make notebooks  execute the notebooks in place"
	@echo "make clean      remove .venv and outputs"

$(VENV)/python.stamp:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "casadi_ik needs Python 3.11 or newer; say make PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	touch $@

$(VENV)/demo.stamp: $(VENV)/python.stamp pyproject.toml constraints.txt
	$(INSTALL) -e ".[plots]"
	touch $@

$(VENV)/dev.stamp: $(VENV)/python.stamp pyproject.toml constraints.txt
	$(INSTALL) -e ".[dev]"
	touch $@ $(VENV)/demo.stamp

# The grasp of a real object by the default method, then by the paper's, and the two side by side.
demo: $(VENV)/demo.stamp
	@mkdir -p $(OUT)
	@# Without OpenGL there is no picture (the first call says so); verdict and log there are.
	$(SOLVE) --picture $(OUT)/cup.png || { [ $$? -eq 2 ] && $(SOLVE); }
	$(PAPER)
	$(BIN)/casadi-ik log compare $(OUT)/cup.mcap $(OUT)/cup_paper.mcap

# One worker more than there are cores, because some tests wait for a browser or another process.
PYTEST := $(BIN)/python -m pytest -n $$($(BIN)/python -c "import os; print(1 + os.cpu_count())")

test: $(VENV)/dev.stamp
	$(PYTEST) -m "not slow"

test-all: $(VENV)/dev.stamp
	$(PYTEST) -m slow

lint: $(VENV)/dev.stamp
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports
	$(BIN)/python tools/check_language.py
	$(SPHINX)

# Of pages and docstrings as they are; notebooks with the outputs that are stored in them.
docs: $(VENV)/dev.stamp
	$(SPHINX)
	@echo "out/docs/index.html"

# Needs node and npm, for three.js.
page: $(VENV)/dev.stamp
	$(BIN)/python page/build.py --out out/page

# Robots are drawn with the visual meshes that are on the machine: `casadi-ik meshes` lists them.
pictures: $(VENV)/dev.stamp page
	$(BIN)/casadi-ik solve cup --scene table --picture docs/cup.png --picture-dark docs/cup_dark.png
	$(BIN)/casadi-ik reach cup --scene table --animation docs/reach.gif
	$(BIN)/python tools/doc_pictures.py --out docs
	$(BIN)/python tools/viewer_pictures.py --out docs --page out/page/index.html
	$(BIN)/python tools/hero.py --out docs
	$(BIN)/python docs/building/figures.py

# Where the other solvers are installed (pip install -r studies/peers.txt) they are measured too.
bench: $(VENV)/dev.stamp
	$(BIN)/python studies/bench.py --report out/bench

notebooks: $(VENV)/dev.stamp
	CASADI_IK_COMPILE=wait $(BIN)/jupyter execute --inplace notebooks/*.ipynb

clean:
	rm -rf $(VENV) out
