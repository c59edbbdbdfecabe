.DEFAULT_GOAL := help
.PHONY: help setup tools demo ruff mypy commits pytest pytest-rest test test-quick test-rest test-all test-cpus test-haswell cpus-here fuzz lint schemas golden api bench findings clean

VENV := .venv
BIN := $(VENV)/bin
PYTHON ?= python3

help:  ## what there is to make
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

# pip would compile modules on one core. Packages may hold templates that do not compile.
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile
COMPILE := $(BIN)/python -m compileall -q -j 0 $(VENV)/lib >/dev/null || true

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# The program and its plain dependencies.
$(VENV)/program: pyproject.toml | $(BIN)/python
	$(PIP_INSTALL) --editable .
	$(COMPILE)
	touch $@

# The same with what tests need.
$(VENV)/ready: pyproject.toml | $(BIN)/python
	$(PIP_INSTALL) --editable '.[test]'
	$(COMPILE)
	touch $(VENV)/program $@

setup: $(VENV)/ready  ## a virtual environment of our own, with everything that tests need

# Debian's packages; NERFBAKE_BLENDER=0 leaves the largest one out, and its test.
READERS := flatbuffers-compiler capnproto python3-openvdb libopenvdb-tools libnanovdb-tools
READERS += g++ libnanovdb-dev zlib1g-dev
READERS += chromium $(if $(shell command -v npm),,nodejs npm)
READERS += libegl-dev libgl-dev libgl1-mesa-dri mesa-vulkan-drivers glslang-tools
READERS += firefox-esr xvfb
READERS += python3-torch mono-mcs mono-runtime
READERS += $(if $(filter 0,$(NERFBAKE_BLENDER)),,blender)

# TypeScript and ESLint, which read the scripts of pages: no page holds anything of them.
SCRIPTS := tests/shaders/scripts

tools:  ## other programs that read our files in tests, OpenVDB to Blender: from Debian, where they are missing and we are root
	@if dpkg -s $(READERS) >/dev/null 2>&1; then :; \
	elif [ "$$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then \
		echo "tests that need a program that is missing are skipped (Debian: $(READERS))"; \
	else apt-get update -qq && apt-get install -y -qq --no-install-recommends $(READERS) >/dev/null; fi
	@if command -v npm >/dev/null && ! cmp -s $(SCRIPTS)/package-lock.json $(SCRIPTS)/node_modules/.installed; then \
		npm ci --prefix $(SCRIPTS) --silent --no-audit --no-fund && \
		cp $(SCRIPTS)/package-lock.json $(SCRIPTS)/node_modules/.installed; fi

demo: $(VENV)/program  ## synthetic scenes, converted, fitted, rendered, inspected and checked: build/demo
	mkdir -p build/demo
	$(BIN)/nerfbake sample octree build/demo/sample.npz --resolution 128 --force
	$(BIN)/nerfbake svo build/demo/sample.npz build/demo/sample.svo.pb --force
	$(BIN)/nerfbake lod build/demo/sample.svo.pb build/demo/sample_64.svo.npz --level 6 --force
	$(BIN)/nerfbake render build/demo/sample.svo.pb --out build/demo/sample.png --force
	$(BIN)/nerfbake info build/demo/sample.svo.pb
	$(BIN)/nerfbake check build/demo/sample.npz
	$(BIN)/nerfbake check build/demo/sample.svo.pb
	$(BIN)/nerfbake check build/demo/sample_64.svo.npz
	$(BIN)/nerfbake sample nerf2mesh build/demo/mesh_stage1 --force
	$(BIN)/nerfbake atlas build/demo/mesh_stage1 build/demo/atlas --clusters 256 --force
	$(BIN)/nerfbake atlas-error build/demo/atlas build/demo/mesh_stage1 --held-out
	$(BIN)/nerfbake vdb build/demo/sample.npz build/demo/sample.vdb --force
	$(BIN)/nerfbake vdb build/demo/sample.svo.pb build/demo/sample.nvdb --grids index --half --force
	$(BIN)/nerfbake check build/demo/sample.vdb
	$(BIN)/nerfbake check build/demo/sample.nvdb
	$(BIN)/nerfbake sample capture build/demo/photographs --force
	$(BIN)/nerfbake fit build/demo/photographs build/demo/fitted.npz --resolution 64 --preset fast --force
	$(BIN)/nerfbake render build/demo/fitted.npz --samples 2 --out build/demo/fitted.png --force
	$(BIN)/nerfbake compress build/demo/fitted.npz build/demo/fitted.svoq --force
	$(BIN)/nerfbake view build/demo/fitted.svoq build/demo/fitted.html --title 'Fitted on this machine' --force
	@printf '%s\n' '' 'Made in build/demo, from scenes that are synthetic:' \
		'  sample.png            look here first: the octree, rendered' \
		'  fitted.html           open it in a browser: a scene fitted to the 24 pictures in photographs' \
		'  fitted.png            the same scene, rendered; fitted.svoq is its file' \
		'  sample.npz            the PlenOctree that all else came from' \
		'  sample.svo.pb         the octree, Protocol Buffers; sample_64.svo.npz is a level coarser, NumPy arrays' \
		'  sample.vdb            density and colour, for Blender and other programs with OpenVDB' \
		'  sample.nvdb           all coefficients, for NanoVDB' \
		'  mesh_stage1, atlas    a mesh with a specular MLP, and the same baked into octahedral maps' \
		'  atlas/scene.glb       the mesh for any viewer of glTF' \
		"Next: '$(BIN)/nerfbake --help', README.md."

lint: ruff mypy commits  ## ruff, mypy --strict, and the subjects of commits

ruff: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

mypy: setup
	$(BIN)/mypy

commits: setup
	$(BIN)/pytest tests/rules/test_commits.py

# Compiled modules are kept, also where the environment asks for none. The number of workers follows.
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/pytest --dist loadfile -n

test: ruff  ## linters and the tests that need nothing but Python packages, on two cores
	$(MAKE) --no-print-directory -j2 mypy pytest

pytest: setup
	$(PYTEST) 2 -m 'not long and not tools'

test-quick: setup  ## the fast ones of these, without linters
	$(PYTEST) 2 -m 'not long and not slow and not tools'

# The older CPU's files are written by one process, which compiles most of the time: the other core runs tests meanwhile.
test-rest: tools setup  ## the tests that `make test` leaves out: other programs, other CPUs, fuzzing, random kills
	$(MAKE) --no-print-directory -j2 test-cpus pytest-rest

pytest-rest: setup
	$(PYTEST) 3 -m 'long or tools'  # one more than cores: many of these tests wait for other programs

test-all: test test-rest  ## every test; none is skipped where $$CI is set

CPUS := $(BIN)/python -m tests.support.cpus
ON_A_CPU := env $(PYTEST) 2 -p no:cacheprovider -m 'not slow and not long and not tools' tests/kernels/maths

test-cpus: setup  ## the same bytes as an older CPU would write, and the tests of our own mathematical functions on it
	mkdir -p build/cpus
	$(MAKE) --no-print-directory -j2 cpus-old cpus-here
	$(CPUS) compare build/cpus/here.json build/cpus/old.json
	NERFBAKE_EXAMPLES=25 $(CPUS) as old $(ON_A_CPU)

test-haswell: setup  ## the same bytes as Haswell would write, which CI does not compare
	mkdir -p build/cpus
	$(MAKE) --no-print-directory -j2 cpus-haswell cpus-here
	$(CPUS) compare build/cpus/here.json build/cpus/haswell.json

cpus-here:
	$(CPUS) write build/cpus/here.json >build/cpus/here.log

cpus-%:
	$(CPUS) as $* $(CPUS) write build/cpus/$*.json >build/cpus/$*.log

MINUTES ?= 30
fuzz: setup  ## hostile files of every format for MINUTES=30, each a case that can be made again
	$(BIN)/python -m tests.fuzz --minutes $(MINUTES)

schemas: setup tools  ## each schema through its own compiler; we generate no code
	mkdir -p build/schemas
	$(BIN)/python -m grpc_tools.protoc -Ischemas --python_out=build/schemas svo.proto voxels.proto
	flatc --python -o build/schemas schemas/svo.fbs
	capnp compile -ocapnp schemas/svo.capnp > build/schemas/svo.capnp.txt

golden: setup  ## what is missing in schemas/conformance: frozen bytes of every format; say why in the commit
	$(BIN)/python -m tests.conformance

api: setup  ## docs/api.md anew, from the docstrings
	$(BIN)/python docs/api.py

bench: setup  ## the figures of the documentation, anew: benchmarks/results; hours
	$(BIN)/python -m benchmarks

findings:  ## surprises of other libraries, run again: findings/README.md; NAME=one of them
	@failed=; for file in findings/$(or $(NAME),*).sh; do \
		echo "== $$file"; bash $$file || failed="$$failed $$file"; \
	done; test -z "$$failed" || { echo "changed:$$failed"; false; }

clean:  ## what make made
	rm -rf $(VENV) build .mypy_cache .pytest_cache .ruff_cache .hypothesis
