# Two commands do everything on a machine with Python 3.11+, pip and make: `make demo` and `make test`.
PYTHON ?= python3

.SECONDARY:  # what a rule makes on the way is kept
.PHONY: demo test test-package test-ros lint docs docs-check reproduce reproduce-small reproduce-things clean

demo: .venv/installed  ## name everything on a bundled table, with the base installation (no torch)
	.venv/bin/nextview demo

# One file is run by one process, of one thread; what it imports is compiled once.
PYTEST = OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= .venv-test/bin/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder

test: .venv-test/installed  ## run the tests of both packages
	$(PYTEST)

test-package: .venv-test/installed  ## run the tests of nextview alone
	$(PYTEST) tests

# Folder with clones of the ten repositories in ros2/environment.py; those that are missing are cloned from GitHub.
ROS_SOURCES ?= .venv-ros/src

test-ros: .venv-ros/installed  ## run the ROS 2 node; Python 3.11, CMake and a C++ compiler, no ROS installation
	AMENT_PREFIX_PATH=$(abspath .venv-ros) OMP_NUM_THREADS=1 .venv-ros/bin/python -m pytest -n 0 tests/test_ros_node.py tests/test_ros_scene.py

lint: .venv-test/installed  ## style and types
	.venv-test/bin/ruff check .
	.venv-test/bin/ruff format --check .
	.venv-test/bin/mypy

docs: .venv-test/installed  ## the documentation site, build/site/index.html; a broken link or notebook ends it
	NO_MKDOCS_2_WARNING=1 .venv-test/bin/mkdocs build
	@echo 'build/site/index.html; for its search: python3 -m http.server -d build/site'

docs-check: .venv-test/installed  ## each command, output and picture of the pages, anew and compared; CHECK="--data data": slow pictures, too; --update
	OMP_NUM_THREADS=1 .venv-test/bin/python workflow/documented_commands.py $(CHECK)

DATA ?= data/ModelNet10
OUT ?= reproduction
# Snakemake's locks outlive a run that was killed; each stage has one of its own that does not.
SNAKEMAKE = .venv-test/bin/snakemake -s workflow/Snakefile --cores all --nolock --rerun-incomplete --quiet rules

reproduce: .venv-test/installed  ## all models, tables and figures from DATA; resumes; CONFIG=models=bundled: tables alone
	$(SNAKEMAKE) --directory $(OUT) --config data=$(abspath $(DATA)) $(CONFIG)

reproduce-small: .venv-test/installed  ## the same on three meshes a class, or on box furniture where DATA is not there
	$(SNAKEMAKE) --directory $(OUT)-small --configfile workflow/small.yaml --config data=$(abspath $(wildcard $(DATA))) $(CONFIG)

YCB ?= data/YCB
PSB ?= data/PSB
THINGS ?= reproduction-things
NEXTVIEW = OMP_NUM_THREADS=1 .venv-test/bin/nextview
LAB = OMP_NUM_THREADS=1 .venv-test/bin/nextview-lab
PYTHON_TEST = OMP_NUM_THREADS=1 .venv-test/bin/python
FIRST_DRAW = --draws 2 --seed 61 --choose-seed 62 --views 1 2 --policies geometry sampled predicted --reference best-blind
NEXT_DRAWS = --draws 2 --views 1 2 --policies geometry --reference

reproduce-things: .venv-test/installed $(foreach seed,60 70 75,$(THINGS)/alike_$(seed)/memory.json)  ## next views, tables and the frozen archive of YCB; a night on two cores; resumes
	$(LAB) benchmark things $(THINGS)/look_alikes_60 $(THINGS)/pairs --models $(THINGS)/alike_60 --families $(FIRST_DRAW)
	$(LAB) benchmark things $(YCB) $(THINGS)/heavy --models ycb --occlusion heavy $(FIRST_DRAW)
	$(LAB) benchmark things $(THINGS)/look_alikes_70 $(THINGS)/pairs_two --models $(THINGS)/alike_70 --families --seed 71 $(NEXT_DRAWS) spread
	$(LAB) benchmark things $(YCB) $(THINGS)/heavy_two --models ycb --occlusion heavy --seed 71 $(NEXT_DRAWS) furthest
	$(LAB) benchmark things $(YCB) $(THINGS)/half_two --models ycb --occlusion half --seed 71 $(NEXT_DRAWS) furthest
	$(LAB) benchmark things $(YCB) $(THINGS)/clear_two --models ycb --seed 71 $(NEXT_DRAWS) furthest
	$(LAB) benchmark things $(THINGS)/look_alikes_75 $(THINGS)/pairs_three --models $(THINGS)/alike_75 --families --seed 74 $(NEXT_DRAWS) spread
	$(LAB) benchmark things $(YCB) $(THINGS)/heavy_three --models ycb --occlusion heavy --seed 74 $(NEXT_DRAWS) furthest
	$(LAB) benchmark things $(YCB) $(THINGS)/half_three --models ycb --occlusion half --seed 74 $(NEXT_DRAWS) furthest
	$(LAB) benchmark things $(YCB) $(THINGS)/clear_three --models ycb --seed 74 $(NEXT_DRAWS) furthest
	$(LAB) benchmark tables $(YCB) $(PSB) $(THINGS)/tables --tables 10 --seed 10 --policies fixed --reference fixed
	test -f $(THINGS)/nextview-bench-small/manifest.json || \
	$(PYTHON_TEST) -m nextview_lab.studies.frozen $(YCB) $(THINGS)/nextview-bench-small --things 12 --draws 3 --grid 3 8 --seed 411
	mkdir -p $(THINGS)/small
	for policy in geometry sampled predicted fixed furthest random spread; do \
		test -f $(THINGS)/small/$$policy.json || \
		$(LAB) submit $(THINGS)/nextview-bench-small $(THINGS)/small/$$policy.json --policy $$policy || exit 1; \
	done
	test -f $(THINGS)/small/icp.json || \
	$(LAB) submit $(THINGS)/nextview-bench-small $(THINGS)/small/icp.json --name "plain ICP" --version 1 --blind \
		--command "$(abspath .venv-test/bin/python) examples/icp_method.py $(abspath $(YCB))"
	$(LAB) leaderboard $(THINGS)/small $(THINGS)/nextview-bench-small $(THINGS)/board --reference "nextview random" --overwrite

$(THINGS)/look_alikes_%/pairs.csv: | .venv-test/installed
	rm -rf $(@D)
	mkdir -p $(THINGS)
	$(PYTHON_TEST) -m nextview_lab.studies.look_alikes $(YCB) $(@D) --models $(DATA) --pairs 50 --seed $*

$(THINGS)/alike_%/memory.json: $(THINGS)/look_alikes_%/pairs.csv
	$(NEXTVIEW) learn $(<D) $(@D) --unit m

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	.venv/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

.venv-test/installed: pyproject.toml lab/pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv-test
	.venv-test/bin/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e '.[bags,cluster,explore,record,teach,dev,workflow,docs]' -e 'lab[arm,benchmark,envs,train]'
	touch $@

.venv-ros/installed: ros2/environment.py pyproject.toml constraints.txt $(wildcard ros2/nextview_msgs/*/*)
	$(PYTHON) ros2/environment.py .venv-ros $(ROS_SOURCES)
	touch $@

clean:
	rm -rf .venv .venv-test .venv-ros nextview_demo nextview_demo.png
