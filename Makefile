# make demo       model the bundled box sequence into runs/demo: one to two minutes the first time, nearly all of it setup, then 10 s
# make setup      prepare .venv for all commands (one to two minutes more, quick if that is done)
# make test       the whole gate: format, lint, types, layers, tests (a quarter of an hour on two cores; installs the extra dev)
# make test-slow  the slow tests, which make test leaves out
# make docs       the guide as a site: build/site/index.html (installs the extra docs; warnings are errors)
# make results    the tables of docs/ and the figures of README.md, from the files of studies/results
# make calibrate  calibration of covariances, on rendered pairs and other cameras (many minutes)
# make trust      reliability of status 0: 150 rendered runs, half with a fault (some 20 minutes a core)
# make ablation   contribution of each stage and constant of the default registration (many hours)
# make bench      speed, against Open3D and the committed baseline
# make bench-gpu  speed on an NVIDIA GPU, against the CPU of the same machine
# make scale      200 small sequences by a batch of two workers, against single builds (some 15 minutes)
# make same       COMMIT=…: compare results with those of another commit, byte by byte
# make audit      locked packages against published advisories, if reachable

BIN := .venv/bin
TWO := -n 2 --dist loadfile  # processes; kernels have threads of their own
unexport PYTHONDONTWRITEBYTECODE  # containers often set it; without bytecode, each start of Python takes 2 s more

.PHONY: setup demo test test-slow docs results calibrate trust ablation bench bench-gpu scale same audit

setup: .venv/.all

.venv/.demo .venv/.all .venv/.dev: pyproject.toml constraints.txt .ci/setup
	PYTHON="$(PYTHON)" .ci/setup $(subst .venv/.,,$@)

demo: .venv/.demo
	$(BIN)/modeler build sequences/bundled/box --prior table --out runs/demo --overwrite
	@echo
	@echo "The mesh is runs/demo/model.ply (any mesh viewer opens it). The recording is runs/demo/recording.rrd; look at it with:"
	@echo "    $(BIN)/modeler view runs/demo          (in a window)"
	@echo "    $(BIN)/modeler view runs/demo --web    (in the browser)"
	@test -e .venv/.all || echo "    make setup                             (installs what the other commands need)"
	@echo "    $(BIN)/modeler report runs/demo        (one page: runs/demo/report.html)"
	@echo "    $(BIN)/modeler export runs/demo --out runs/box.glb"

test: .venv/.dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/basedpyright
	$(BIN)/lint-imports
	$(BIN)/pytest $(TWO)

test-slow: .venv/.dev
	$(BIN)/pytest -m slow $(TWO)

docs: .venv/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "The guide is build/site/index.html; its search works where it is served: $(BIN)/mkdocs serve"

.venv/.docs: .venv/.all
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[docs]"
	touch $@

results: setup
	$(BIN)/python -m studies results

calibrate: setup
	$(BIN)/python -m studies calibration
	$(BIN)/python -m studies calibration.by_camera

trust: setup
	$(BIN)/python -m studies trust --jobs 2

ablation: setup
	$(BIN)/python -m studies ablation

bench: setup
	$(BIN)/python -m studies bench

bench-gpu: .venv/.dev
	$(BIN)/python -m studies bench.gpu

scale: setup
	$(BIN)/python -m studies scale builds runs/scale

same: setup
	$(BIN)/python -m studies same_bytes $(COMMIT)

audit: setup
	.ci/audit
