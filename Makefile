# make setup      prepare .venv (quick when it is there)
# make demo       model the bundled box sequence into runs/demo
# make test       the whole gate: format, lint, types, layers, tests
# make calibrate  the slow tests of calibration (many minutes)
# make bench      timings and accuracy, against the committed baseline

BIN := .venv/bin

.PHONY: setup demo test calibrate bench
.DELETE_ON_ERROR:

setup: .venv/.installed

.venv/.installed: pyproject.toml constraints.txt .ci/setup
	PYTHON="$(PYTHON)" .ci/setup

demo: setup
	$(BIN)/modeler build sequences/bundled/box --prior table --out runs/demo --overwrite
	@echo
	@echo "The mesh:      runs/demo/model.ply      (MeshLab, Blender, or: $(BIN)/modeler export runs/demo --out box.glb)"
	@echo "The recording: runs/demo/recording.rrd  (look at it with: $(BIN)/modeler view runs/demo)"

test: setup
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/basedpyright
	$(BIN)/lint-imports
	$(BIN)/pytest

calibrate: setup
	$(BIN)/pytest -m slow --timeout 0

bench: setup
	$(BIN)/python -m benchmarks
