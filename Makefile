# make install   the virtual environment .venv, with everything
# make train     trains SAID on a MuJoCo task under delay, evaluates it beside its expert and draws a plot
# make report    README's table and picture, from the raw files of results/; with EACH=--each every training seed's table
# make demo      draws demo.gif: a trained agent under delay, beside the same agent told that every observation is new
# make test      lint, types and tests: what CI runs
# make format    rewrites the code as `make lint` wants it

VENV := .venv
PY := $(VENV)/bin/python
# The first interpreter that runs and can make environments; PYTHON=/path/to/python overrides it.
PYTHON ?= $(firstword $(foreach p,python3.13 python3.12 python3.11 python3.10 python3,\
	$(shell $(p) -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 10))' >/dev/null 2>&1 && echo $(p))))

ALGO := said
ENV := InvertedPendulum-v5
DELAY := 4
PRESET := quick
LOGS := logs
EPISODES := 20

# The agents of README's table
AGENTS := window_weights/hopper_seed1 window_weights/hopper_seed2 window_weights/hopper_seed3 \
	window_weights/walker2d_seed1 window_weights/walker2d_seed2 window_weights/walker2d_seed3 \
	window_weights/halfcheetah_seed1 window_weights/halfcheetah_seed2 window_weights/halfcheetah_seed3 \
	window_weights/ant_seed1 window_weights/ant_seed2 window_weights/ant_seed3

.PHONY: install train report demo test lint type pytest format clean

install: $(VENV)/.installed

# The stamp is newer than its inputs once everything is installed, so a second `make install` does nothing.
$(VENV)/.installed: setup.cfg pyproject.toml constraints.txt scripts/install_torch.sh
	@test -x $(PY) || test -n "$(PYTHON)" || { echo "No Python >= 3.10 with venv found: make install PYTHON=/path/to/python"; exit 1; }
	test -x $(PY) || $(PYTHON) -m venv $(VENV)
	scripts/install_torch.sh $(PY)
	$(PY) -m pip install -c constraints.txt -e ".[all]"
	touch $@

# The run's folder is the one that the training prints when it saves; the newest folder may be another run's.
# Ctrl-C is for the training, which then saves what it has learned; tee -i goes on until then.
# One decision is too small for two threads: they wait for each other wherever another process is busy.
train: install
	log=$$(mktemp) && \
	$(PY) -u scripts/train.py --algo $(ALGO) --env $(ENV) --delay $(DELAY) --preset $(PRESET) -f "$(LOGS)" | tee -i $$log; \
	run=$$(sed -n 's/^Saving to //p' $$log); rm -f $$log; test -n "$$run" && \
	$(PY) scripts/evaluate.py "$$run" --episodes $(EPISODES) --num-threads 1 --plot "$$run/evaluation.png"

report: install
	$(PY) benchmarks/online_table.py $(AGENTS:%=results/agents/%.json) \
		--plot results/agents/agents.png $(EACH)

demo: install
	$(PY) scripts/enjoy.py agents/hopper.zip --delay 8 --beside-ignorant --size 240 --fps 12 --record demo.gif

test: lint type pytest

lint: install
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .

type: install
	$(PY) -m mypy

# One thread a worker: the tests' networks are small, and workers that share cores slow each other down.
pytest: install
	OMP_NUM_THREADS=1 $(PY) -m pytest -n 2 --dist worksteal

format: install
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

clean:
	rm -rf build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
	find sb3_said scripts tests -name __pycache__ -type d -prune -exec rm -rf {} +
