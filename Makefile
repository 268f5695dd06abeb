# `make demo` and `make test` need git and Python 3.11 or newer with venv; they make .venv first.
# A .venv that exists is kept: pip installs what is missing in it or has another version.
PYTHON ?= python3
BIN := .venv/bin
SHELL := bash
.SHELLFLAGS := -o pipefail -c

.PHONY: demo test changes lint results clean

demo: $(BIN)/.run
	@echo "Ten runs of PPO, five of them with noise: about two minutes on one core"
	PYTHON=$(BIN)/python ./benchmark.sh demo
	@echo "Now analyze.py, once: tables and figures, in a few seconds"
	@$(BIN)/python analyze.py --runs-dir runs/demo >runs/demo/logs/analysis.txt
	@echo
	@sed '/^$$/q' runs/demo/logs/analysis.txt  # the verdict
	@echo "The picture: runs/demo/results/curves_PPO_RandomNormalNoisyObservation_1.0.svg"
	@echo "All tables and figures: runs/demo/results/report.html"
	@echo "The curves in TensorBoard: .venv/bin/tensorboard --logdir runs/demo"

test: $(BIN)/.dev
	$(BIN)/python -m pytest --numprocesses 3 --dist worksteal

# Every change of docs/changing.md through tools/check_script.py and a sweep (`make test` does two),
# and a rehearsal of tools/gpu_check.sh.
changes: $(BIN)/.dev
	CHANGES=all $(BIN)/python -m pytest --numprocesses 3 --dist worksteal \
	tests/scripts/test_changing.py tests/scripts/test_gpu_check.py

lint: $(BIN)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	for script in benchmark.sh sweep/executors.sh .ci/run; do bash -n $$script || exit; done
	$(BIN)/shellcheck --external-sources --check-sourced benchmark.sh .ci/run tools/gpu_check.sh

# The tables that results/study computes from results/data, and the tables in the pages. Those of a
# finished study were computed once, at the commit that results/tables/README.md names.
results: $(BIN)/.dev
	$(BIN)/python -m results.study
	$(BIN)/python -m results.study.picture
	$(BIN)/python -m cogapp -r -P -I . -p "from results.study.show import table" results/*.md results/*/README.md

clean:
	rm -rf .venv runs/demo

$(BIN)/python:
	$(PYTHON) -m venv .venv

# pip shows its own progress on a terminal; elsewhere one line tells each package.
INSTALL = if [ -t 1 ]; then $(BIN)/python -m pip install --requirement $<; else \
	$(BIN)/python -m pip install --progress-bar off --requirement $< \
	| sed -nu -e 's/^Collecting \([^ ]*\).*/fetching \1/p' -e 's/^Installing c.*/installing them/p' \
	-e '/^Successfully/p'; fi

$(BIN)/.size: | $(BIN)/python
	@$(BIN)/python -c "import torch" 2>/dev/null || { \
	echo "Installing into .venv: about 3 GB are fetched, most of them PyTorch's CUDA libraries."; \
	echo "The CPU-only PyTorch makes it 0.4 GB: README.md, Install, says how. Ctrl-C stops here."; }
	@touch $@

$(BIN)/.run: requirements.txt | $(BIN)/.size
	@$(INSTALL)
	@touch $@

$(BIN)/.dev: requirements-dev.txt requirements.txt | $(BIN)/.size
	@$(INSTALL)
	@touch $@ $(BIN)/.run
