# The one door. `make train` runs the main job, `make test` passes the tests; both install what they need.
PYTHON ?= $(shell command -v python3.11 || uv python find --quiet 3.11 2>/dev/null || command -v python3)
BIN := .venv/bin
ARGS ?=

.PHONY: install train demo coco test smoke check docs bench gpu-check slurm-check ray-check format clean

install: .venv/installed

.venv/installed: pyproject.toml constraints.txt assets.txt
	@$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info[:2] == (3, 11) else "see2act needs Python 3.11. Get it by `uv python install 3.11` (make finds that one), `conda create -n py311 python=3.11` or your system, and type make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	$(BIN)/pip install --quiet --no-deps --requirement assets.txt
	@touch $@

train: install  ## make train ARGS="task=normal transfer=full primitive=suction seed=3"
	$(BIN)/python train.py $(ARGS)

demo: install  ## a trained robot clears a bin: make demo ARGS="primitive=grasp objects=random_urdfs seed=5"
	$(BIN)/python demo.py $(ARGS)

coco: install  ## real COCO weights for model=nanodet_g task=coco, by npm
	$(BIN)/see2act coco $(ARGS)

test: check
	$(BIN)/python -m pytest --numprocesses 2 --dist loadscope $(ARGS)

smoke: install  ## every cell of the benchmark once, tiny, and the report of it
	$(BIN)/python train.py -m experiment=smoke $(ARGS)
	$(BIN)/python report.py multirun/smoke

bench: install  ## about 25 minutes; nothing else should run beside it
	$(BIN)/python -m benchmarks.speed $(ARGS)

gpu-check: install  ## where there is a GPU: a short run of both networks on it, and a table of times against the processor
	$(BIN)/python -m benchmarks.gpu $(ARGS)

slurm-check: install  ## a sweep on a SLURM cluster on this machine, which a job of is killed; wants slurm-wlm and munge by apt-get
	$(BIN)/python -m benchmarks.slurm $(ARGS)

ray-check: .venv-ray/installed  ## a sweep on two nodes of Ray on this machine, of which one is killed
	.venv-ray/bin/python -m benchmarks.ray_nodes $(ARGS)

.venv-ray/installed: .venv/installed pyproject.toml assets.txt
	$(PYTHON) -m venv .venv-ray
	.venv-ray/bin/pip install --quiet --editable '.[ray]'  # without constraints.txt: Ray needs an older cloudpickle
	.venv-ray/bin/pip install --quiet --no-deps --requirement assets.txt
	@touch $@

check: install
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

docs: install  ## the docs site, in build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

format: install
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean:
	rm -rf .venv .venv-ray build *.egg-info .mypy_cache .ruff_cache .pytest_cache
