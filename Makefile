# Everything that a person or a machine does here; `make help` explains each target.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/ready

SEED ?= 1
DEMO := demo/studies-$(SEED)/patient-0001
STUDY ?= $(DEMO)
OUT ?= demo/products-$(SEED)
STUDIES ?= demo/studies-$(SEED)
CONFIG ?= configs/default.yaml
WORKERS ?= 2

# Rules read them as "$$STUDY", for names may hold spaces and quotes; Make itself takes $$ for $.
export STUDY OUT STUDIES CONFIG
# A study of one's own is there, and Make knows no names with spaces.
DEMO_STUDY := $(if $(filter-out $(DEMO),$(STUDY)),$(READY),$(DEMO)/study.yaml)

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

demo: $(DEMO_STUDY) ## a synthetic patient becomes a force field, with a report at the end (SEED=1)
	mkdir -p "$$OUT"
	$(BIN)/beatfield run "$$STUDY" --out "$$OUT" --config "$$CONFIG" | tee "$$OUT.txt"
	@sed -n 's/^query  *beatfield //p' "$$OUT.txt" | xargs $(BIN)/beatfield

$(DEMO)/study.yaml: $(READY)
	$(BIN)/beatfield synth demo/studies-$(SEED) --seed $(SEED) --overwrite

paper: $(READY) ## the paper's figures and table, re-run from the demo's field: paper/index.html
	test -d "$$OUT/patient-0001/bake/field.zarr" || $(MAKE) demo
	$(BIN)/beatfield paper paper --products "$$OUT/patient-0001" --study "$$STUDY"

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

TRAIN := $(BIN)/python -m data_synth.training --pool training/pool
# What runs of training did not see yet, each with all that came after it.
NO_RARE := --without rare
NO_ILL := --without ill $(NO_RARE)
NO_ENDS := --without ends $(NO_ILL)
NO_BASE := --without base $(NO_ENDS)
NO_FINE := --without fine $(NO_BASE)

train: setup ## make both networks' weights anew from the phantom (eight hours; needs PyTorch)
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[train]'
	$(TRAIN) --out training --without rims --without bare $(NO_FINE)
	$(TRAIN) --out training/second $(NO_FINE) --start training/heart.pt \
		--learning-rate 1e-3 --steps 8000
	$(TRAIN) --out training/third $(NO_FINE) --seed 1 --hearts 80 \
		--start training/second/heart.pt --learning-rate 1e-3 --steps 5000
	$(TRAIN) --out training/fourth $(NO_BASE) --seed 2 --hearts 0 --more 0 240 --more 1 80 \
		--start training/third/heart.pt --learning-rate 1e-3 --steps 6000
	$(TRAIN) --out training/fifth $(NO_ENDS) --seed 5 --hearts 140 \
		--start training/fourth/heart.pt --learning-rate 7e-4 --steps 5500 \
		--halfway-from training/fourth/heart.pt
	$(TRAIN) --out training/sixth $(NO_ENDS) --seed 6 --hearts 0 --more 5 140 \
		--start training/fifth/heart.pt --learning-rate 7e-4 --steps 4500 \
		--halfway-from training/fifth/heart.pt
	$(TRAIN) --out training/seventh $(NO_ILL) --seed 7 --hearts 120 --more 5 140 \
		--start training/sixth/heart.pt --learning-rate 7e-4 --steps 7000 \
		--halfway-from training/sixth/heart.pt
	$(TRAIN) --out training/eighth $(NO_ILL) --seed 8 --hearts 0 --more 7 120 --more 5 140 \
		--start training/seventh/heart.pt --learning-rate 7e-4 --steps 6000 \
		--halfway-from training/seventh/heart.pt
	$(TRAIN) --out training/ninth $(NO_RARE) --seed 9 --hearts 0 --more 7 120 --more 5 140 \
		--start training/eighth/heart.pt --learning-rate 7e-4 --steps 7000
	$(TRAIN) --out training/tenth $(NO_RARE) --seed 10 --hearts 0 --more 7 120 --more 5 140 \
		--start training/ninth/heart.pt --learning-rate 7e-4 --steps 5500 \
		--halfway-from training/eighth/heart.pt
	$(TRAIN) --out training/eleventh --seed 11 --hearts 0 --more 7 120 --more 5 140 \
		--start training/tenth/heart.pt --learning-rate 7e-4 --steps 7500 \
		--halfway-from training/tenth/heart.pt
	cp training/eleventh/heart.onnx pipeline/imaging/weights/heart.onnx
	$(BIN)/python -m data_synth.training.ultrasound --out training/ultrasound
	cp training/ultrasound/blood.onnx pipeline/registration/weights/blood.onnx

$(STAGES): setup
	$(BIN)/beatfield $@ "$$STUDY" --out "$$OUT" --config "$$CONFIG"

batch: setup ## run a folder of studies: make batch STUDIES=... OUT=... WORKERS=2
	$(BIN)/beatfield batch "$$STUDIES" --out "$$OUT" --workers $(WORKERS) --config "$$CONFIG"

clean: ## remove demo/ (products without OUT= too), paper/, training/, caches and .venv
	rm -rf demo paper training $(VENV) .mypy_cache .pytest_cache .ruff_cache .hypothesis .benchmarks
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
