# ridetune from a clean checkout: `make demo` builds whatever is missing on the way.
# Each stage is one file rule, so a second run redoes only what changed.

PYTHON ?= python3
VENV = .venv
# Where frames come from: synthetic, or nuscenes, images, video, mcap with ROOT=folder.
SOURCE = synthetic
ROOT =
# What the weather was, which videos and logs do not say: sunny, rain, fog, snow or night.
CONDITION =
# In which languages the passengers speak (LANGUAGES=en,de,es,zh), and a CSV file of your own
# commands: text, style, level, intent, language.
LANGUAGES = en
COMMANDS =
RUN = runs/$(if $(filter synthetic,$(SOURCE)),tiny,$(SOURCE))
BASE = models/tiny
FRAMES =
PORT = 8470

PY = $(VENV)/bin/python
SPEECH = "speech.languages=[$(LANGUAGES)]" $(if $(COMMANDS),"speech.own='$(COMMANDS)'")
INSTALLED = $(VENV)/.installed
LIBRARY = $(wildcard ridetune/*.py ridetune/*/*.py)
EXPORT = $(addprefix quantize/,export.py graphs.py onnx_files.py operators.py parity.py)
BENCHMARK = quantize/benchmark.py quantize/served_memory.py
# What a result of the evaluation is made by; the page is drawn anew without measuring anew.
REPORT = $(addprefix evaluate/,__main__.py report.py alignment.py decisions.py)
PAGE = $(wildcard evaluate/page_parts/*) $(addprefix evaluate/,page.py animation.py curves.py \
	plots.py sections.py style_drives.py tables.py)
SWEEP = $(addprefix evaluate/,sweep.py sweep_runs.py)
LOOP = $(filter-out evaluate/report.py $(PAGE) $(SWEEP),$(wildcard evaluate/*.py))
SIMULATION = $(wildcard ridetune/control/*.py ridetune/sim/*.py) configs/ranges.yaml \
	configs/vehicle.yaml
SYNTHETIC = $(addprefix data/,__main__.py annotate.py bank_files.py build.py feedback.py held_out.py \
	instructions.py own_commands.py phrases.py)
CONTRACT = $(addprefix ridetune/,alignment.py codec.py config.py matrix.py sample.py stage.py)

# Every model is a folder on this disk; nothing is looked up elsewhere.
export HF_HUB_OFFLINE = 1

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help venv data train quantize bench sweep envelope evaluate serve demo test lint types clean

help:  ## Print this list
	@grep -E '^[a-z]+:.*## ' $(firstword $(MAKEFILE_LIST)) | sed -E 's/^([a-z]+):[^#]*## /\1|/' \
		| awk -F '|' '{ printf "  make %-10s %s\n", $$1, $$2 }'

venv: $(INSTALLED)  ## Create .venv and install everything (PYTHON=python3.12 picks another)
data: $(RUN)/data/manifest.json  ## Build the dataset (SOURCE=nuscenes ROOT=folder: from real frames)
train: $(RUN)/merged/manifest.json  ## Fine-tune with LoRA and merge the adapter
quantize: $(RUN)/bundle/bundle.json  ## Quantize to 4-bit AWQ and export the bundle
bench: $(RUN)/evaluation.json  ## Profile the bundle's latency and score what it does
sweep: $(RUN)/sweep.json  ## Drive 5,040 drawn matrices through every scenario and condition
evaluate: $(RUN)/report.html  ## Drive, score, and write it all on one page

envelope: $(INSTALLED)  ## Compute what the gate lets through anew (configs/verified.yaml, committed)
	$(PY) -m evaluate.envelope --config configs/envelope.yaml

serve: $(RUN)/.profiled  ## Serve the bundle on this machine (PORT=8470)
	$(PY) -m serve --config configs/serve.yaml bundle=$(RUN)/bundle port=$(PORT)

demo: $(RUN)/.profiled  ## Ask the served bundle three things (FRAMES=folder of photos)
	$(PY) -m serve.demo --config configs/demo.yaml \
		bundle=$(RUN)/bundle data=$(RUN)/data $(if $(FRAMES),"frames='$(FRAMES)'")

test: $(INSTALLED)  ## Run the tests
	$(PY) -m pytest

lint: $(INSTALLED)  ## Check format and style
	$(PY) -m ruff format --check .
	$(PY) -m ruff check .

types: $(INSTALLED)  ## Check types
	$(PY) -m mypy

clean:  ## Delete the run and the tools' caches; .venv and models stay
	rm -rf $(RUN) build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +

# torch first and alone: the other packages then settle on this build of it.
$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and \
		"ridetune needs Python 3.11 or newer; name one with make PYTHON=python3.12")'
	test -x $(PY) || $(PYTHON) -m venv $(VENV)
	$(PY) -m pip install -c constraints.txt torch==2.13.0
	$(PY) -m pip install -c constraints.txt -e ".[all,dev]"
	@touch $@

ifeq ($(SOURCE),synthetic)
$(RUN)/data/manifest.json: $(SYNTHETIC) $(wildcard data/bank/*.yaml data/bank/*/*.yaml ridetune/camera/*.py) $(CONTRACT) \
		configs/data.yaml configs/ranges.yaml | $(INSTALLED)
	$(PY) -m data --config configs/data.yaml out=$(RUN)/data $(SPEECH)
else
# Parts that are there stay; a change of the folder's content wants a new RUN.
$(RUN)/data/manifest.json: configs/propose.yaml configs/data-export.yaml | $(INSTALLED)
	$(PY) -m data.propose --config configs/propose.yaml \
		source=$(SOURCE) "root='$(ROOT)'" out=$(RUN)/proposals \
		$(if $(CONDITION),condition=$(CONDITION)) $(SPEECH)
	$(PY) -m data.export --config configs/data-export.yaml \
		proposals=$(RUN)/proposals out=$(RUN)/data
endif

$(RUN)/merged/manifest.json: $(RUN)/data/manifest.json $(wildcard train/*.py) $(CONTRACT) \
		ridetune/prompt.py ridetune/vision.py ridetune/contract.py ridetune/qwen.py \
		configs/train.yaml $(wildcard $(BASE)/*.json $(BASE)/*.safetensors) | $(INSTALLED)
	$(PY) -m train --config configs/train.yaml \
		base=$(BASE) data=$(RUN)/data adapter=$(RUN)/adapter out=$(RUN)/merged

$(RUN)/awq/manifest.json: $(RUN)/merged/manifest.json \
		$(filter-out $(EXPORT) $(BENCHMARK),$(wildcard quantize/*.py)) \
		ridetune/awq_checkpoint.py ridetune/gemm.py ridetune/qwen.py \
		configs/quantize.yaml | $(INSTALLED)
	$(PY) -m quantize --config configs/quantize.yaml \
		model=$(RUN)/merged data=$(RUN)/data out=$(RUN)/awq

$(RUN)/bundle/bundle.json: $(RUN)/awq/manifest.json $(EXPORT) \
		ridetune/bundle.py ridetune/ort_engine.py configs/export.yaml | $(INSTALLED)
	$(PY) -m quantize.export --config configs/export.yaml \
		model=$(RUN)/awq data=$(RUN)/data out=$(RUN)/bundle

# The benchmark writes its profile into bundle.json, which makes that file newer than itself:
# the stamp is touched afterwards, so that neither rule starts the other again.
$(RUN)/.profiled: $(RUN)/bundle/bundle.json $(BENCHMARK) configs/benchmark.yaml configs/verified.yaml \
		| $(INSTALLED)
	$(PY) -m quantize.benchmark --config configs/benchmark.yaml \
		bundle=$(RUN)/bundle data=$(RUN)/data run=$(RUN) out=$(RUN)/profile
	@touch $@

$(RUN)/evaluation.json: $(RUN)/.profiled $(REPORT) $(LIBRARY) configs/evaluate.yaml configs/verified.yaml \
		| $(INSTALLED)
	$(PY) -m evaluate --config configs/evaluate.yaml bundle=$(RUN)/bundle data=$(RUN)/data \
		merged=$(RUN)/merged quantized=$(RUN)/awq out=$@

$(RUN)/closed_loop.json: $(RUN)/.profiled $(LOOP) $(LIBRARY) configs/closed_loop.yaml \
		configs/driving_score.yaml configs/vehicle.yaml configs/verified.yaml | $(INSTALLED)
	$(PY) -m evaluate.closed_loop --config configs/closed_loop.yaml bundle=$(RUN)/bundle \
		data=$(RUN)/data out=$@

$(RUN)/sweep.json: $(SWEEP) $(SIMULATION) configs/sweep.yaml | $(INSTALLED)
	$(PY) -m evaluate.sweep --config configs/sweep.yaml out=$@

$(RUN)/report.html: $(RUN)/evaluation.json $(RUN)/closed_loop.json $(RUN)/sweep.json $(PAGE) \
		$(SIMULATION) configs/page.yaml configs/driving_score.yaml | $(INSTALLED)
	$(PY) -m evaluate.page --config configs/page.yaml evaluation=$(RUN)/evaluation.json \
		profile=$(RUN)/profile/profile.json closed_loop=$(RUN)/closed_loop.json \
		sweep=$(RUN)/sweep.json out=$@
