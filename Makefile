# `make demo` and `make test` need git and Python 3.11 or newer with venv; they make .venv first.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test lint results clean

demo: $(BIN)/.run
	@echo "Ten runs of PPO, five of them with noise: about three minutes on one core"
	PYTHON=$(BIN)/python ./benchmark.sh demo
	$(BIN)/python analyze.py --runs-dir runs/demo >runs/demo/logs/analysis.txt
	@echo
	@head -n 2 runs/demo/logs/analysis.txt
	@echo "The picture: runs/demo/results/curves_PPO_RandomNormalNoisyObservation_1.0.svg"
	@echo "All tables and figures: runs/demo/results/report.html"
	@echo "The curves in TensorBoard: .venv/bin/tensorboard --logdir runs/demo"

test: $(BIN)/.dev
	$(BIN)/python -m pytest --numprocesses 3 --dist worksteal

lint: $(BIN)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	for script in benchmark.sh sweep/executors.sh .ci/run; do bash -n $$script || exit; done
	$(BIN)/shellcheck --external-sources --check-sourced benchmark.sh .ci/run

# The tables that results/study computes from results/data, and the tables in the pages. Those of a
# finished study were computed once, at the commit that results/tables/README.md names.
results: $(BIN)/.dev
	$(BIN)/python -m results.study
	$(BIN)/cog -r -P -I . -p "from results.study.show import table" results/*.md results/data/*.md results/tables/*.md

clean:
	rm -rf .venv runs/demo results/report

$(BIN)/python:
	$(PYTHON) -m venv .venv

$(BIN)/.run: requirements.txt | $(BIN)/python
	$(BIN)/pip install --quiet --requirement $<
	touch $@

$(BIN)/.dev: requirements-dev.txt requirements.txt | $(BIN)/python
	$(BIN)/pip install --quiet --requirement $<
	touch $@ $(BIN)/.run
