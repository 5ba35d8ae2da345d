# freshfield: `make demo` and `make test` need python3 >= 3.11 (with venv) and make, nothing else.
#
# Everything installs into .venv beside this file. The first call takes minutes (torch is large), the
# following ones start at once: the stamps .venv/.ok-* follow pyproject.toml.

PYTHON ?= python3

# Package index for torch alone. Empty: pip's own configuration decides, which on Linux means the build with
# CUDA (several gigabytes). Without a GPU, set this to PyTorch's CPU wheel index (its address is in PyTorch's
# installation guide), or name that index in pip's configuration:  make demo TORCH_INDEX=ADDRESS
TORCH_INDEX ?=

# Options of `make demo`.
SCENARIO ?= deploy/scenarios/card.yaml
# Seconds (60s, 5m) after everything is up; 0 = until Ctrl-C.
FOR ?= 60s
OUT ?= runs/demo
PORT ?= 8080
# Folder of recorded data, for scenarios that stream it (fox, lego, kitchen).
DATA ?=

# Options of `make figures`: studies (names, or groups as edge-server study has them), processes, and more for each
# study, such as --quick or --seeds 40.
FIGURES ?= all viewpoints preferences learning
JOBS ?=
STUDY ?=

# Options of `make mutants`: seed and number of edits.
SEED ?= 1
COUNT ?= 200

# Options of `make images`: docker or podman, and more for its build, such as --build-arg TORCH=cpu.
ENGINE ?= docker
BUILD ?=
BASE := $(shell sed -n 's/^ARG BASE=//p' deploy/edge.Dockerfile)

# Options of `make test`: which marks, and more for pytest.
SELECT ?= not slow
PYTEST ?=

PY := .venv/bin/python
# Byte code is made by the first import of what is used: compiling all of it ahead doubles the set-up's time. It
# lies in .venv, also where the environment wants none beside the sources: hundreds of processes are started,
# and without it torch and numba take three seconds instead of one in each.
export PYTHONPYCACHEPREFIX := $(abspath .venv)/byte-code
unexport PYTHONDONTWRITEBYTECODE
INSTALL := $(PY) -m pip --disable-pip-version-check -q install --no-compile
WARM_UP = PYTHONPATH=proto:. $(PY) -m edge_server.fields.warm_up_command --field $(1)
# Kernels, and the numbers that they hold as constants.
KERNELS := $(shell find edge_server/fields -path '*/kernels/*.py' -o -name settings.py -o -name "*_constants.py")
# The line of pyproject.toml that starts with a name.
wanted = $(shell sed -n 's/^ *"\($(1)[^"]*\)",*$$/\1/p' pyproject.toml | head -n 1)
TORCH := $(shell sed -n 's/^\(torch==[^ ]*\).*/\1/p' deploy/locks/torch-cuda.txt)
# Into folder $(1), without the static methods that gRPC calls experimental and nobody here calls.
define PROTOC
cd proto && ../$(PY) -m grpc_tools.protoc -I . --pyi_out=$(1) --python_out=$(1) --grpc_python_out=$(1) \
  freshfield/v1/*.proto && \
  sed -i.all '/add_registered_method_handlers/,$${//!d;}' $(1)/freshfield/v1/*_grpc.py && rm $(1)/freshfield/v1/*.all
endef
BROWSER := $(firstword $(shell command -v chromium chromium-browser google-chrome 2>/dev/null))

.DEFAULT_GOAL := help
.PHONY: help demo test docs lint format types bench figures mutants reference proto proto-check lock images clean

help:  ## what there is to make
	@sed -n 's/^\([a-z-]*\):.*  ## \(.*\)/  make \1\t\2/p' $(firstword $(MAKEFILE_LIST)) | expand -t 22

# An arm's client library, where the scenario (a file, or the name of a shipped one) has an arm.
ARM := $(if $(shell grep -ls '^ *arm:' $(SCENARIO) deploy/scenarios/$(SCENARIO).yaml),.venv/.ok-arm)

demo: .venv/.ok-run .venv/.ok-kernels $(ARM)  ## run a scenario: SCENARIO=FILE FOR=60s OUT=runs/demo PORT=8080 DATA=FOLDER
	@.venv/bin/freshfield demo $(SCENARIO) --for=$(FOR) --out $(OUT) --port $(PORT) $(if $(DATA),--data $(DATA))

# Two passes: what only computes on all cores, then what meets clocks and ports. 5: nothing was selected.
CHOSEN = ($(SELECT))$(if $(BROWSER),, and not browser)
test: .venv/.ok-all-kernels  ## all tests but the slow ones (the browser's too, where there is one)
	@echo "tests that compute, side by side"; $(PY) -m pytest -n logical --dist worksteal \
	  -m "$(CHOSEN) and side_by_side" $(PYTEST); first=$$?; \
	echo "tests that need the machine to themselves"; $(PY) -m pytest \
	  -m "$(CHOSEN) and not side_by_side" $(PYTEST); second=$$?; \
	for code in $$first $$second; do [ $$code = 0 ] || [ $$code = 5 ] || exit $$code; done

docs: .venv/.ok-docs  ## the documentation as a site: site/index.html
	@NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict --quiet
	@echo "site/index.html; with search: $(PYTHON) -m http.server -d site"

lint: .venv/.ok-test  ## ruff: rules and format
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .

format: .venv/.ok-test  ## ruff: apply the format and the safe fixes
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

types: .venv/.ok-test  ## mypy
	$(PY) -m mypy
	MYPYPATH=proto:deploy $(PY) -m mypy deploy/freshfield_up

reference: .venv/.ok-test  ## write docs/reference/scenario.md anew: keys, bounds and defaults, as the code has them
	$(PY) docs/site_pages.py

bench: .venv/.ok-test  ## what a frame costs emulator and ingest, by the number of cameras: runs/bench.json
	@mkdir -p runs
	$(PY) -m tests.tools.scale --json runs/bench.json

figures: .venv/.ok-test  ## the thesis's figures, hours to days: docs/results/thesis; DATA=FOLDER JOBS=2 STUDY=--quick
	for name in $(FIGURES); do \
	  $(if $(DATA),FRESHFIELD_DATA=$(DATA)) .venv/bin/edge-server study $$name --out runs/figures \
	    $(if $(JOBS),--jobs $(JOBS)) $(STUDY) || exit 1; \
	done  # after Ctrl-C the same command goes on
	@mkdir -p docs/results/thesis
	cp $$(ls -d runs/figures/*.json runs/figures/*.csv runs/figures/*.png runs/figures/*.md 2>/dev/null) docs/results/thesis

mutants: .venv/.ok-test  ## careless edits drawn from a seed, and whether quick tests notice, hours: SEED=1 COUNT=200
	$(PY) -m tests.mutation_sample --seed $(SEED) --count $(COUNT)

proto: .venv/.ok-test  ## regenerate proto/freshfield/v1 from its .proto files
	$(call PROTOC,.)

proto-check: .venv/.ok-test  ## fail where the generated code differs from its .proto files
	@rm -rf .venv/proto-check && mkdir -p .venv/proto-check
	@$(call PROTOC,../.venv/proto-check)
	@for file in .venv/proto-check/freshfield/v1/*; do \
	  diff -u proto/freshfield/v1/$$(basename $$file) $$file || \
	  { echo "proto/freshfield/v1 is not what its .proto files say: run 'make proto' and commit"; exit 1; }; \
	done
	@echo "generated code matches the .proto files"

# Wheels for Python 3.11 on Linux. edge: all but torch and what only torch needs, which its two locks have. torch keeps
# its version, unless TORCH=torch==... names another. Indexes are uv's: UV_DEFAULT_INDEX, UV_FIND_LINKS.
LOCK = ../../.venv/bin/uv pip compile -q --upgrade --generate-hashes --no-annotate --python-version 3.11 \
  --only-binary :all: --custom-compile-command "make lock" $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))
lock: .venv/.ok-venv  ## resolve the images' packages anew into deploy/locks; the CPU build of torch: TORCH_INDEX
	$(INSTALL) uv
	@echo 'torch; python_version < "3"' >.venv/without-torch.txt
	cd deploy/locks && \
	  $(LOCK) ../../pyproject.toml --extra edge --extra embed --override ../../.venv/without-torch.txt -o edge.txt && \
	  $(LOCK) ../../pyproject.toml -c edge.txt -o camera.txt && \
	  echo "$(subst ==,===,$(TORCH))" | $(LOCK) - -c edge.txt -o torch-cuda.txt && \
	  echo "$(subst ==,===,$(TORCH))+cpu" | $(LOCK) - -c edge.txt -o torch-cpu.txt && \
	  ../../$(PY) -c 'import tomllib; print(*tomllib.load(open("../../pyproject.toml", "rb"))["build-system"]["requires"], sep="\n")' | \
	  $(LOCK) - -o build.txt

images:  ## build both images on the base image's newest digest: ENGINE=docker, BUILD for more options
	$(ENGINE) pull -q $(BASE)
	base=$$($(ENGINE) image inspect --format '{{index .RepoDigests 0}}' $(BASE)) && echo "on $$base" && \
	for image in camera edge; do \
	  $(ENGINE) build --build-arg BASE=$$base --label org.opencontainers.image.base.name=$$base $(BUILD) \
	    -f deploy/$$image.Dockerfile -t localhost/freshfield-$$image . || exit 1; \
	done

clean:  ## remove the virtual environment and every cache (runs/ stays)
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis build dist site
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# --- set-up ---

.venv/.ok-venv:
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) not found: install Python 3.11 or newer, or name one with PYTHON=..."; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "$$($(PYTHON) --version) is too old: freshfield needs 3.11 or newer; name one with PYTHON=..."; exit 1; }
	@echo "set-up 1/2: virtual environment (.venv)"
	@$(PYTHON) -m venv .venv || { rm -rf .venv; echo "cannot make a virtual environment (Debian: apt-get install python3-venv)"; exit 1; }
	@touch $@

# torch apart from the rest: TORCH_INDEX decides where it comes from and nothing else does. What it needs
# itself comes with the rest, when pip can see that torch is there.
.venv/.ok-torch: .venv/.ok-venv pyproject.toml
	@$(INSTALL) --no-deps $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) $(TORCH)
	@touch $@

.venv/.ok-numba: .venv/.ok-venv pyproject.toml
	@$(INSTALL) --no-warn-conflicts '$(call wanted,numba)' '$(call wanted,opencv)' '$(call wanted,msgspec)'
	@touch $@

.venv/.ok-edge: .venv/.ok-torch .venv/.ok-numba
	@$(INSTALL) -e '.[edge,embed]'
	@touch $@

# The field's kernels are compiled at their first use, which takes some ten seconds: better beside the
# installation of everything else than after it, and again where they have changed. Should it fail here, the edge
# server tries again.
.venv/.ok-kernels: .venv/.ok-numba $(KERNELS)
	@echo "compiling the field's kernels"; $(call WARM_UP,splat) >.venv/kernels.log 2>&1 || \
	  echo "the kernels were not compiled ahead (.venv/kernels.log): the edge server will do it at its start"
	@touch $@

.venv/.ok-run: .venv/.ok-venv pyproject.toml
	@echo "set-up 2/2: $(TORCH) and the rest; beside it the field's kernels are compiled"
	@$(MAKE) --no-print-directory -j2 .venv/.ok-edge .venv/.ok-kernels
	@touch $@

.venv/.ok-arm: .venv/.ok-run
	@$(INSTALL) -e '.[ur]'
	@touch $@

.venv/.ok-test: .venv/.ok-run pyproject.toml
	@echo "test tools"
	@$(INSTALL) -e '.[edge,embed,test,dev]'
	@touch $@

.venv/.ok-docs: .venv/.ok-run pyproject.toml
	@$(INSTALL) -e '.[edge,embed,docs]'
	@touch $@

# The other fields' kernels, at once in two processes: two processes of tests would compile all of them twice.
.venv/.ok-all-kernels: .venv/.ok-test .venv/.ok-kernels
	@echo "compiling the other fields' kernels"
	@{ $(call WARM_UP,nerfacto) & $(call WARM_UP,ngp) && $(call WARM_UP,tensorf) && wait $$!; } >>.venv/kernels.log 2>&1 || \
	  echo "they were not compiled ahead (.venv/kernels.log): tests will do it"
	@touch $@

# What slow tests need besides: Ray, some 240 MB; scikit-image and pycolmap for surfaces; and what tests of cameras and arms skip without, 200 MB.
.venv/.ok-slow: .venv/.ok-test
	@$(INSTALL) -e '.[cluster,surface,spz,colmap,ur,oak,realsense,mcap,ros,foxglove]'
	@touch $@
