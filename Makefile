# Everything that a person or a machine does here; `make help` explains each target.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/ready

STUDY ?= demo/studies-$(SEED)/patient-0001
OUT ?= demo/products-$(SEED)
STUDIES ?= demo/studies-$(SEED)
CONFIG ?= configs/default.yaml
WORKERS ?= 2
SEED ?= 1

STAGES := ingest segment surface register bake evaluate report

.PHONY: help setup demo paper test check lint types bench train batch clean $(STAGES)

help: ## explain every target
	@sed -n 's/^\([a-z][a-z |]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | awk -F'\t' '{printf "%-10s %s\n", $$1, $$2}'
	@echo "$(STAGES):"
	@echo "           one stage, those before it brought up to date: make segment STUDY=... OUT=... CONFIG=..."

setup: $(READY) ## make .venv with the tested versions of everything (a minute or two)

$(READY): requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $@

demo: $(STUDY)/study.yaml ## a synthetic patient becomes a force field, with a report at the end (SEED=1)
	$(BIN)/beatfield run $(STUDY) --out $(OUT) --config $(CONFIG) | tee $(OUT).txt
	@sed -n 's/^query  *beatfield //p' $(OUT).txt | xargs $(BIN)/beatfield

demo/studies-$(SEED)/patient-0001/study.yaml: $(READY)
	$(BIN)/beatfield synth demo/studies-$(SEED) --seed $(SEED) --overwrite

paper: $(READY) ## the paper's figures and table, re-run from the demo's field: paper/index.html
	test -d $(OUT)/patient-0001/bake/field.zarr || $(MAKE) demo
	$(BIN)/beatfield paper paper --products $(OUT)/patient-0001 --study $(STUDY)

test: setup ## run all tests
	$(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder -q

check: lint types test ## all that CI runs: lint, types, test

lint: setup ## formatting and lint
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: setup ## static types
	$(BIN)/mypy

bench: setup ## speed beside peers, as ratios in one run
	$(BIN)/pytest --benchmark-enable --benchmark-only -q benchmarks

train: setup ## make the segmentation weights anew from the phantom (six and a half hours; needs PyTorch)
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[train]'
	$(BIN)/python -m data_synth.training --out training --without rims --without bare --without fine \
		--without base --without ends --without ill
	$(BIN)/python -m data_synth.training --out training/second --pool training/pool --without fine \
		--without base --without ends --without ill --start training/heart.pt \
		--learning-rate 1e-3 --steps 8000
	$(BIN)/python -m data_synth.training --out training/third --pool training/pool --without fine \
		--without base --without ends --without ill --seed 1 --hearts 80 \
		--start training/second/heart.pt --learning-rate 1e-3 --steps 5000
	$(BIN)/python -m data_synth.training --out training/fourth --pool training/pool --without base \
		--without ends --without ill --seed 2 --hearts 0 --more 0 240 --more 1 80 \
		--start training/third/heart.pt --learning-rate 1e-3 --steps 6000
	$(BIN)/python -m data_synth.training --out training/fifth --pool training/pool --seed 5 \
		--hearts 140 --without ends --without ill --start training/fourth/heart.pt \
		--learning-rate 7e-4 --steps 5500 --halfway-from training/fourth/heart.pt
	$(BIN)/python -m data_synth.training --out training/sixth --pool training/pool --seed 6 \
		--hearts 0 --more 5 140 --without ends --without ill --start training/fifth/heart.pt \
		--learning-rate 7e-4 --steps 4500 --halfway-from training/fifth/heart.pt
	$(BIN)/python -m data_synth.training --out training/seventh --pool training/pool --seed 7 \
		--hearts 120 --more 5 140 --without ill --start training/sixth/heart.pt \
		--learning-rate 7e-4 --steps 7000 --halfway-from training/sixth/heart.pt
	$(BIN)/python -m data_synth.training --out training/eighth --pool training/pool --seed 8 \
		--hearts 0 --more 7 120 --more 5 140 --without ill --start training/seventh/heart.pt \
		--learning-rate 7e-4 --steps 6000 --halfway-from training/seventh/heart.pt
	$(BIN)/python -m data_synth.training --out training/ninth --pool training/pool --seed 9 \
		--hearts 0 --more 7 120 --more 5 140 --start training/eighth/heart.pt \
		--learning-rate 7e-4 --steps 7000
	$(BIN)/python -m data_synth.training --out training/tenth --pool training/pool --seed 10 \
		--hearts 0 --more 7 120 --more 5 140 --start training/ninth/heart.pt \
		--learning-rate 7e-4 --steps 5500 --halfway-from training/eighth/heart.pt
	cp training/tenth/heart.onnx pipeline/imaging/weights/heart.onnx

$(STAGES): setup
	$(BIN)/beatfield $@ $(STUDY) --out $(OUT) --config $(CONFIG)

batch: setup ## run a folder of studies: make batch STUDIES=... OUT=... WORKERS=2
	$(BIN)/beatfield batch $(STUDIES) --out $(OUT) --workers $(WORKERS) --config $(CONFIG)

clean: ## remove the demo, caches and the virtual environment
	rm -rf demo paper training $(VENV) .mypy_cache .pytest_cache .ruff_cache .hypothesis .benchmarks
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
