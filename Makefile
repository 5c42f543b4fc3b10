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
DEMO_OUT := demo/products-$(SEED)
OUT ?= $(DEMO_OUT)
STUDIES ?= demo/studies-$(SEED)
CONFIG ?= configs/default.yaml
WORKERS ?= 2

# Rules read them as "$$STUDY", for names may hold spaces and quotes; Make itself takes $$ for $.
export STUDY OUT STUDIES CONFIG
# A study of one's own is there, and Make knows no names with spaces.
DEMO_STUDY := $(if $(filter-out $(DEMO),$(STUDY)),$(READY),$(DEMO)/study.yaml)

STAGES := ingest segment surface register bake evaluate report

ifneq (,$(filter demo batch $(STAGES),$(MAKECMDGOALS)))
$(foreach one,STUDY OUT STUDIES CONFIG,$(if $(strip $($(one))),,$(error $(one)= is empty: give it a value)))
endif

# Stages of one study follow each other, and demo studies are made once.
.NOTPARALLEL:
.PHONY: help setup demo paper test test-all check lint types bench train batch clean $(STAGES)

help: ## explain every target
	@sed -n 's/^\([a-z][a-z |-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | awk -F'\t' '{printf "%-10s %s\n", $$1, $$2}'
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
	$(BIN)/beatfield run "$$STUDY" --out "$$OUT" --config "$$CONFIG" | tee "$${OUT%/}.txt"
	@sed -n 's/^query  *beatfield //p' "$${OUT%/}.txt" | xargs $(BIN)/beatfield

$(DEMO)/study.yaml: $(READY)
	$(BIN)/beatfield synth demo/studies-$(SEED) --seed $(SEED) --overwrite

paper: $(READY) ## the paper's figures and table, re-run from the demo's field: paper/index.html
	test -d $(DEMO_OUT)/patient-0001/bake/field.zarr || $(MAKE) demo STUDY=$(DEMO) OUT=$(DEMO_OUT)
	$(BIN)/beatfield paper paper --products $(DEMO_OUT)/patient-0001 --study $(DEMO)

PYTEST := $(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder -q

test: setup ## run the tests
	$(PYTEST) -m "not slow"

test-all: setup ## run all tests, the slow ones too
	$(PYTEST)

check: lint types test ## all that CI runs: lint, types, test

lint: setup ## formatting and lint
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: setup ## static types
	$(BIN)/mypy

bench: setup ## speed beside peers, as ratios in one run
	$(BIN)/pytest --benchmark-enable --benchmark-only -q benchmarks

TRAIN := $(BIN)/python -m data_synth.training --pool training/pool --workers $(WORKERS)
NARROW := --widths 16 40 88 168 272

train: setup ## make both networks' weights anew, or go on with that (needs PyTorch; a GPU: an hour)
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[train]'
	$(TRAIN) --out training $(NARROW) --steps 87850 --fresh 4 --without span --without filters \
		--without mishaps
	$(TRAIN) --out training/second $(NARROW) --start training/heart.pt --seed 1 --hearts 10 --more 0 600 \
		--learning-rate 4e-4 --steps 2050 --batch 16 --fresh 12 --kept 5000 --without filters \
		--without mishaps
	$(TRAIN) --out training/third $(NARROW) --start training/second/heart.pt --more 1 10 \
		--learning-rate 3e-4 --steps 3050 --batch 16 --fresh 12 --kept 5000 --without mishaps
	$(TRAIN) --out training/fourth $(NARROW) --start training/third/heart.pt --more 1 10 \
		--learning-rate 3e-4 --steps 2950 --batch 16 --fresh 12 --kept 5000
	$(TRAIN) --out training/fifth --start training/fourth/heart.pt --more 1 10 --more 2 290 \
		--learning-rate 1.5e-3 --steps 36850 --fresh 6
	$(TRAIN) --out training/sixth --start training/fifth/heart.pt --seed 1 --hearts 10 \
		--more 0 600 --more 2 290 --learning-rate 3e-4 --steps 2390 --batch 16 --fresh 16 --kept 1000
	$(TRAIN) --out training/seventh --start training/sixth/heart.pt --seed 2 --hearts 290 \
		--more 0 600 --more 1 10 --learning-rate 1e-3 --steps 54870 --fresh 6
	$(TRAIN) --out training/eighth --start training/seventh/heart.pt --seed 1 --hearts 10 \
		--more 2 290 --more 0 600 --learning-rate 3e-4 --steps 5670 --batch 16 --fresh 16 --kept 1000
	$(TRAIN) --out training/mean --mean training/sixth/heart.pt --mean training/eighth/heart.pt \
		--seed 1 --hearts 10 --more 2 290 --more 0 600
	cp training/mean/heart.onnx pipeline/imaging/weights/heart.onnx
	$(BIN)/python -m data_synth.training.ultrasound --out training/ultrasound --workers $(WORKERS)
	cp training/ultrasound/blood.onnx pipeline/registration/weights/blood.onnx

$(STAGES): $(DEMO_STUDY)
	$(BIN)/beatfield $@ "$$STUDY" --out "$$OUT" --config "$$CONFIG"

batch: setup ## run a folder of studies: make batch STUDIES=... OUT=... WORKERS=2
	$(BIN)/beatfield batch "$$STUDIES" --out "$$OUT" --workers $(WORKERS) --config "$$CONFIG"

clean: ## remove demo/ (products without OUT= too), paper/, training/, caches and .venv
	rm -rf demo paper training $(VENV) .mypy_cache .pytest_cache .ruff_cache .hypothesis .benchmarks
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
