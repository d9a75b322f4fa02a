# Every target makes .venv and installs what it needs by itself.
PYTHON ?= python3
BIN := .venv/bin
SCENARIO := clbench/Fetch-v1
QUICK := build/quick
# Images for containers often set it. Every process would then compile what it imports: PyTorch took 8 s instead of 3.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help leaderboard tuning records ladder controls docs site benchmark test test-long test-slow libero-test check style types committed wheel-test clean

define HELP
make leaderboard  install, run two methods with one seed, and show a table, in minutes
make test         most of the tests, in minutes
make test-long    the tests that take a second and more, many of them whole runs
make test-slow    the tests that take minutes each
make check        the next three, side by side with -j3
make style        format and lint
make types        types
make committed    whether committed pages and definitions are those of the records and the code; the page in a browser
make libero-test  install LIBERO (1.7 GB), and compare our world with it
make wheel-test   build the wheel, and test it outside the clone
make site         the documentation as a site: build/site/index.html
make docs         the pages of docs/reference, from the code and the records
make tuning       missing tuning runs, and the settings of the methods
make records      missing records of the boards, then the leaderboard
make ladder       missing records of the ladder of learning rates
make controls     missing records that only the claims need
make benchmark    speed, in two hours on an idle machine
make clean        delete .venv, build and dist
endef

# The first target is what `make` alone does.
help:
	@: $(info $(HELP))

# The main target: install, run and show a table in minutes, with one seed. The full board takes `make records`.
leaderboard:
	@start=$$(date +%s) \
		&& $(MAKE) --no-print-directory .venv/installed \
		&& $(BIN)/clbench run $(SCENARIO) sft experience_replay --seeds 1 --records $(QUICK)/records \
		&& $(BIN)/clbench leaderboard --records $(QUICK)/records \
		&& seconds=$$(($$(date +%s) - start)) \
		&& echo "This table took $$((seconds / 60)) min $$((seconds % 60)) s, installing included."

# Scenarios at equal learning: methods are tuned on them, and most claims are judged on them.
BOARDS := clbench/Fetch-v1 clbench/MetaWorld-v1
comma := ,
space := $(subst ,, )
BOTH := $(subst $(space),$(comma),$(BOARDS))

METHODS := aegis consft consft_calibrated experience_replay fast_dvla finch l2_sp lora sft stop_gradient
REFERENCES := frozen joint from_scratch
CONSFT_CONTROLS := constant_weight shuffled_weights
# Further methods that keep demonstrations or what they taught, on Fetch-v1 alone, where a run takes up to five minutes.
RIVALS := a_gem buffered_replay ewc
# Methods on PointMaze-v1. Of its ladder, the claims need the first rung only.
SCHEDULED := consft consft_calibrated
MAZE := aegis $(SCHEDULED) experience_replay fast_dvla finch l2_sp lora sft stop_gradient
CLAIMED := $(BOTH),clbench/PointMaze-v1

# The settings of every method, from validation episodes of seeds that no board has. Run it before `make records`.
tuning: .venv/installed-libero
	for id in $(BOARDS); do $(BIN)/clbench tune $$id $(METHODS) --write methods/tuned/$${id#clbench/}.json || exit; done
	$(BIN)/clbench tune clbench/Fetch-v1 $(RIVALS) --write methods/tuned/Fetch-v1.json
	$(BIN)/clbench tune clbench/PointMaze-v1 $(filter-out $(SCHEDULED),$(MAZE)) --write methods/tuned/PointMaze-v1.json
	$(BIN)/clbench tune clbench/PointMaze-v1 $(SCHEDULED) --set.schedule 3.25 --write methods/tuned/PointMaze-v1.json
	$(BIN)/clbench tune clbench/LiberoSpatial-v1 experience_replay sft --write methods/tuned/LiberoSpatial-v1.json
	$(BIN)/clbench tune clbench/LiberoSpatial-v1 $(SCHEDULED) --set.schedule 3.5 --write methods/tuned/LiberoSpatial-v1.json

# Scenarios whose stages have a fixed number of steps: plain fine-tuning, replay and the references.
FIXED := clbench/DMControl-v0,clbench/FetchPixels-v0

# The committed boards. Runs that have a record are skipped: a stopped command goes on. Seeds in fours are whole Latin
# squares of orders. The policy of size base has one seed: 4.9 million parameters take up to 21 minutes a run.
records: .venv/installed-libero
	$(BIN)/clbench run clbench/Fetch-v1 sft consft consft_calibrated --seeds 12 --perturb
	$(BIN)/clbench run clbench/Fetch-v1 $(REFERENCES) $(METHODS) $(CONSFT_CONTROLS) $(RIVALS) --seeds 12
	$(BIN)/clbench run clbench/MetaWorld-v1 $(REFERENCES) $(METHODS) $(CONSFT_CONTROLS) --seeds 8
	$(BIN)/clbench run clbench/PointMaze-v1 $(REFERENCES) $(MAZE) $(CONSFT_CONTROLS) --seeds 8
	$(BIN)/clbench run $(KNOWLEDGE) frozen joint sft stop_gradient aegis lora --seeds 4
	$(BIN)/clbench run clbench/LiberoSpatial-v1 $(SCHEDULED) $(CONSFT_CONTROLS) experience_replay from_scratch frozen joint sft \
		--seeds 4
	$(BIN)/clbench run clbench/Fetch-v1 frozen sft consft aegis experience_replay lora stop_gradient --seeds 3 \
		--policy discrete_diffusion
	$(BIN)/clbench run clbench/Fetch-v1 sft experience_replay lora --seeds 1 --policy flow-base
	$(BIN)/clbench run $(FIXED),clbench/MetaWorldCW-v0 sft frozen joint from_scratch --seeds 3
	$(BIN)/clbench run $(FIXED) experience_replay --seeds 3
	for id in PointMaze-v1 DMControl-v0; do \
		$(BIN)/python docs/guide/online_sac.py clbench/$$id --seeds 3 || exit; \
		$(BIN)/python docs/guide/online_sac.py clbench/$$id --seeds 3 --replay || exit; \
	done
	$(BIN)/clbench leaderboard

# The frontier: what a smaller learning rate does, for plain fine-tuning and for the methods that compete with it. The
# claims need consft_calibrated at the scenario's own learning rate only. On Fetch-v1, tuning rated plain fine-tuning at
# 0.1 as highly as at 0.3, the first: a gain is certain only if it is over both.
LADDER = $(BIN)/clbench run $(BOTH) $(filter-out consft_calibrated,$(METHODS)) --seeds 4 --records leaderboard/ladder
ladder: .venv/installed-libero
	$(LADDER) --set.step_factor 1
	$(LADDER) --set.step_factor 0.3
	$(LADDER) --set.step_factor 0.1
	$(LADDER) --set.step_factor 0.03
	$(BIN)/clbench run clbench/Fetch-v1 sft --set.step_factor 0.1 --seeds 12 --records leaderboard/ladder
	$(BIN)/clbench run $(CLAIMED) consft_calibrated --set.step_factor 1 --seeds 4 --records leaderboard/ladder
	$(BIN)/clbench run clbench/PointMaze-v1 sft consft fast_dvla --set.step_factor 1 --seeds 4 --records leaderboard/ladder
	$(BIN)/clbench run clbench/LiberoSpatial-v1 sft $(SCHEDULED) --set.step_factor 1 --seeds 4 --records leaderboard/ladder

# Further records for docs/reference/claims.md: methods with one change that shows what causes their effect.
KNOWLEDGE := clbench/FetchKnowledge-v1
CONTROLS := --seeds 4 --records leaderboard/controls
controls: .venv/installed-dev
	$(BIN)/clbench run $(CLAIMED) co_training --set.step_factor 1 $(CONTROLS)
	$(BIN)/clbench run $(CLAIMED) fast_dvla --set.direction random --set.step_factor 1 $(CONTROLS)
	$(BIN)/clbench run $(CLAIMED) fast_dvla --set.orthogonal 0 --set.step_factor 1 $(CONTROLS)
	$(BIN)/clbench run clbench/Fetch-v1 $(CONSFT_CONTROLS) --set.step_factor 1 $(CONTROLS)
	$(BIN)/clbench run $(KNOWLEDGE) aegis --set.direction random $(CONTROLS)
	$(BIN)/clbench run $(KNOWLEDGE) lora --set.rank 4 $(CONTROLS)
	$(BIN)/clbench run $(KNOWLEDGE) lora --set.rank 64 $(CONTROLS)

# The pages of docs/reference, from the code, the records and leaderboard/decoding.json; experts are measured once, and the
# film is made once.
FILM := docs/reference/scenarios/Fetch-v1/film.gif
docs: .venv/installed-dev $(FILM)
	$(BIN)/clbench claims
	$(BIN)/clbench findings
	$(BIN)/clbench method-pages
	$(BIN)/clbench metrics --markdown docs/reference/metrics.md
	$(BIN)/clbench scenario-card

$(FILM): | .venv/installed-dev
	$(BIN)/clbench film $(SCENARIO) sft experience_replay --tasks pick_and_place --size 180 --output $@

# docs/ as a site, the reference of the Python names and the interactive leaderboard included: build/site/index.html.
site: .venv/installed-docs
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet --builder html docs build/site

# Speed, as ratios: benchmarks/results/, and docs/reference/performance.md from them. It takes two hours on an idle machine.
benchmark: .venv/installed-dev
	$(BIN)/python benchmarks/rollouts.py
	$(BIN)/python benchmarks/step_time.py
	$(BIN)/python benchmarks/decoding.py
	for id in Fetch-v1 MetaWorld-v1 PointMaze-v1 DMControl-v0 MetaWorldCW-v0; do \
		$(BIN)/python benchmarks/whole_run.py clbench/$$id || exit; \
	done
	$(BIN)/python benchmarks/workers.py
	$(BIN)/python benchmarks/served_policy.py
	$(BIN)/python benchmarks/page.py
	$(BIN)/python benchmarks/scaling.py
	$(BIN)/python benchmarks/overlap.py
	$(BIN)/python benchmarks/report.py

test: .venv/installed-dev
	$(BIN)/pytest

# What takes a second or more of one core: whole runs, every method's contract, films, killed commands.
test-long: .venv/installed-dev
	$(BIN)/pytest -m "long and not slow"

# What takes minutes: random input for longer, a Ray cluster, and all that a stranger types from nothing to a row.
test-slow: .venv/installed-dev
	$(BIN)/pytest -m slow

# LIBERO's scenario, and its world beside LIBERO's own, which the extra brings: 1.7 GB. Elsewhere its tests are skipped.
libero-test: .venv/installed-libero
	$(BIN)/pytest tests/envs/test_libero.py tests/envs/test_libero_physics.py tests/envs/test_libero_scenario.py
	$(BIN)/pytest tests/envs/test_every_scenario.py -k Libero

check: style types committed
style: .venv/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
types: .venv/installed-dev
	$(BIN)/mypy

# Whether the committed board and pages are those of the committed records, whether every scenario is what its definition
# says, and the page in a browser.
CHECKED := tests/leaderboard/test_records.py tests/evaluation/test_definition.py \
	tests/scoring/test_statistics_page.py tests/base/test_source.py \
	$(addprefix tests/leaderboard/views/page/test_,in_browser.py on_a_phone.py published_page.py ways.py)
committed: .venv/installed-dev
	$(BIN)/pytest -m "slow or long" $(CHECKED)

# Tests of the built wheel outside the checkout, where it could differ from the checkout: its files, the parts that are
# found by name, the commands, and all that strangers type. It has an environment of its own, which sees the packages of
# .venv but not the checkout: to install PyTorch a second time took 90 s.
WHEEL_TESTS := $(addprefix tests/,cli/test_main.py cli/test_scaffold.py leaderboard/pages/test_cli.py \
	leaderboard/views/test_markdown.py runs/test_agents_guide.py serving/test_guide.py test_package.py test_readme.py \
	test_submission.py test_your_scenario.py) \
	tests/methods/test_methods.py::test_the_link_of_a_method_is_the_first_paper_that_its_module_names
wheel-test: .venv/installed-dev
	rm -rf build/wheel && mkdir -p build/wheel
	$(BIN)/python -m build --wheel --no-isolation --outdir build/wheel . >/dev/null
	$(BIN)/python -m zipfile -l build/wheel/*.whl | grep -v '^File\|^clbench/\|^clbench-[^/]*dist-info/'; test $$? -eq 1
	$(BIN)/python -m venv --without-pip build/wheel/venv
	$(BIN)/pip --python build/wheel/venv/bin/python install -q --no-deps build/wheel/*.whl
	echo $$PWD/.venv/lib/python3.*/site-packages > $$(echo build/wheel/venv/lib/python3.*/site-packages)/packages.pth
	$(BIN)/pip --python build/wheel/venv/bin/python check
	outside=$$(mktemp -d) && cp -r tests docs pyproject.toml *.md *.cff LICENSE "$$outside" && here=$$PWD && cd "$$outside" \
		&& $$here/build/wheel/venv/bin/python -m pytest -m "slow or not long" $(WHEEL_TESTS) && rm -rf "$$outside"

clean:
	rm -rf .venv build dist

$(BIN)/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12), (3, 13)) and \
	  "clbench needs Python 3.11, 3.12 or 3.13, not %d.%d: name one with make PYTHON=python3.12" % sys.version_info[:2])'
	$(PYTHON) -m venv .venv
# Python 3.11 brings pip 23.2, which takes 41 s of processor time for the packages that pip 26.3 installs in 21 s.
	$(BIN)/pip install -q -U pip

# Each adds an extra. Python compiles what it imports, and keeps it: with every module compiled here, and two calls of pip
# for the development environment, that one took 263 s instead of 149.
INSTALL := $(BIN)/pip install -q --no-compile -c constraints.txt -e
.venv/installed: pyproject.toml constraints.txt | $(BIN)/pip
	$(INSTALL) .
	@touch $@

.venv/installed-dev: pyproject.toml constraints.txt | $(BIN)/pip
	$(INSTALL) ".[dev]"
	@touch .venv/installed $@

.venv/installed-libero: .venv/installed-dev
	$(INSTALL) ".[dev,libero]"
	@touch $@

.venv/installed-docs: .venv/installed
	$(INSTALL) ".[docs]"
	@touch $@
