# Everything a developer or CI runs. `make help` lists the targets.
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin/python
INSTALLED := $(VENV)/.installed
TRAINS := $(VENV)/.trains
# Python compiles what it imports, and keeps it; compiling all of PyTorch takes longer.
unexport PYTHONDONTWRITEBYTECODE
PIP := $(RUN) -m pip install --no-compile -c constraints.txt

.PHONY: help demo test lint format compiled test-fast test-slow test-wheel docs urdf pictures figures gradients compare results bench-learning bench-cloning bench-kinematics bench-engine bench-long bench-limits bench-transfer bench-engines bench-fidelity bench-evaluate bench-conveyor bench-speed bench-shield bench-first bench-crossing bench-cycle bench-tasks soak clean
.DEFAULT_GOAL := help

help: ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 18

$(INSTALLED): $(TRAINS)
	$(PIP) -e ".[train,test,docs]"
	touch $@

$(TRAINS): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install --upgrade pip
	$(PIP) -e ".[train]"
	touch $@

demo: $(TRAINS) ## train pick-and-place in the analytic engine, test it in PyBullet, film it; see runs/demo/
	$(VENV)/bin/tpm-gym train --algo ppo --engine analytic --env TPMPickAndPlaceDense-v0 --seed 0 --test-episodes 0 \
		--run runs/demo/pick_and_place --overwrite
	cp runs/demo/pick_and_place/learning_curve.png runs/demo/learning_curve.png
	$(MAKE) -j2 demo-table demo-film
	@echo; echo "runs/demo/ now holds:"; ls runs/demo runs/demo/pick_and_place

.PHONY: demo-table demo-film
demo-table:
	$(VENV)/bin/tpm-gym evaluate --policy runs/demo/pick_and_place/best.json expert random \
		--env TPMPickAndPlaceDense-v0 --episodes 100 --json runs/demo/pick_and_place.json

demo-film:
	$(VENV)/bin/tpm-gym evaluate --policy runs/demo/pick_and_place/best.json --episodes 2 --seed 2000006 \
		--video runs/demo/pick_and_place.mp4 --picture runs/demo/pick_and_place.png

test: $(INSTALLED) ## all checks, here and in CI: lint, types, fast tests
	$(MAKE) -j2 lint compiled
	$(MAKE) test-fast

lint: $(INSTALLED)
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m mypy
	$(VENV)/bin/lint-imports --no-logo

format: $(INSTALLED) ## rewrite the code in the house style
	$(RUN) -m ruff check --fix .
	$(RUN) -m ruff format .

compiled: $(INSTALLED) # once, before several processes would do it at the same time
	$(RUN) tests/support/compile_all.py

test-fast: $(INSTALLED)
	$(RUN) -m pytest -q -n logical --maxprocesses 8 --dist worksteal

test-slow: $(INSTALLED) ## tests that take minutes: hundreds of episodes, training to success
	$(RUN) -m pytest -q -m slow -n logical --maxprocesses 8 --dist worksteal

test-wheel: $(INSTALLED) ## the wheel in an empty environment: train, kill, resume, evaluate
	$(RUN) -m pytest -q -m slow tests/learning/test_wheel.py

docs: $(INSTALLED) ## build the documentation in build/docs/html; warnings are errors
	$(VENV)/bin/tpm-gym view --export docs/_static/viewer
	$(RUN) -m sphinx -E -W --keep-going --nitpicky -b html docs build/docs/html

urdf: $(INSTALLED) ## regenerate urdf/ from the mechanism
	$(RUN) -m tpm_gym.mechanism.export urdf

pictures: $(INSTALLED) ## redraw the README's moving picture; half a minute
	$(RUN) docs/draw_pictures.py

figures: $(INSTALLED) ## redraw the paper's figures, and more, in docs/images/
	$(RUN) docs/draw_figures.py

compare: $(INSTALLED) ## the TPM and the Delta, measured; see docs/compare.md
	$(RUN) benchmarks/compare.py --write

gradients: $(INSTALLED) ## lengths and ways improved by gradients, again; see docs/gradients.md; minutes
	$(RUN) docs/draw_gradients.py

results: $(INSTALLED) ## rewrite docs/results.md and its figures from the records in docs/results/
	$(RUN) -m benchmarks.studies write

bench-learning: $(INSTALLED) ## train and test all ids with five seeds, as far as it is not done; see docs/benchmark.md; hours
	$(RUN) -m benchmarks.studies run --plan benchmark --engine analytic --folder runs/benchmark
	$(RUN) -m benchmarks.studies collect --runs runs/benchmark
	$(MAKE) results

bench-cloning: $(INSTALLED) ## behaviour cloning from 10, 50 and 400 episodes; see docs/datasets.md; minutes
	$(RUN) benchmarks/bench_cloning.py --write

bench-kinematics: $(INSTALLED) ## speed of the kinematics against a floor and a general solver
	$(RUN) benchmarks/bench_kinematics.py

bench-fidelity: $(INSTALLED) ## loop gaps, FK error and tilt against cost; see docs/loops.md
	$(RUN) benchmarks/bench_fidelity.py --write

bench-evaluate: $(INSTALLED) ## what tpm-gym evaluate costs beyond the stepping
	$(RUN) benchmarks/bench_evaluate.py --json runs/evaluate.json

bench-conveyor: $(INSTALLED) ## picks a minute from a belt, beside supply and bound; see docs/conveyor.md
	$(RUN) benchmarks/bench_conveyor.py --write

bench-engines: $(INSTALLED) ## both engines and theory on the same commands; policies over engines and drives
	$(RUN) benchmarks/bench_engines.py --jobs 2 --write

bench-engine: $(INSTALLED) ## the analytic engine: speed and agreement, beside PyBullet and panda-gym
	$(PIP) -e ".[bench]"
	$(RUN) benchmarks/bench_engine.py --write
	$(RUN) benchmarks/readme_numbers.py

bench-long: $(INSTALLED) ## loop gaps and FK error over a million time steps a motion; see docs/fidelity.md; minutes
	$(RUN) benchmarks/bench_fidelity.py --long 1000000 --write

bench-limits: $(INSTALLED) ## success in each engine at two time steps; see docs/analytic-engine.md; minutes
	$(RUN) benchmarks/engine_limits.py --jobs 2 --write

bench-transfer: $(INSTALLED) ## policies trained in one engine, tested in all; see docs/transfer.md; an hour
	$(RUN) benchmarks/bench_transfer.py --jobs 2 --write

bench-first: $(INSTALLED) ## from the start of Python to the first step, with and without compiled code on disk
	$(RUN) benchmarks/bench_first.py

bench-shield: $(INSTALLED) ## the shield: violations, margins, cost, policies; hours with training
	for seed in 0 1 2 3 4; do for shield in "" --shield; do \
		$(VENV)/bin/tpm-gym train --algo ppo --engine analytic --env TPMReachJointsDense-v0 --goals tempting \
		--test-episodes 0 --seed $$seed $$shield --run runs/shield/s$$seed$$shield --overwrite; done; done
	$(RUN) benchmarks/bench_shield.py --write

bench-tasks: $(INSTALLED) ## success of the expert in each task, engine and condition; see docs/tasks.md; an hour
	$(RUN) benchmarks/bench_tasks.py --write

bench-crossing: $(INSTALLED) ## passages of y = 0 in each engine; see docs/crossing.md; minutes
	$(RUN) benchmarks/bench_crossing.py --write

bench-cycle: $(INSTALLED) ## cycle times and torques of 25-305-25 mm in each engine; see docs/cycle.md; minutes
	$(RUN) benchmarks/bench_cycle.py --write

bench-speed: $(INSTALLED) ## steps per second beside panda-gym and Gymnasium-Robotics
	$(PIP) -e ".[bench]"
	$(RUN) benchmarks/bench_speed.py --json docs/records/speed.json
	$(RUN) benchmarks/readme_numbers.py

soak: $(INSTALLED) ## a million steps over all ids in PyBullet, and in MuJoCo: memory, loop gaps, speed; an hour
	$(RUN) benchmarks/soak.py --json runs/soak.json --plot runs/soak.png
	$(RUN) benchmarks/soak.py --engine mujoco --warm-up 250000 --json runs/soak_mujoco.json --plot runs/soak_mujoco.png

clean: ## remove the environment and everything generated
	rm -rf $(VENV) runs dist build docs/generated .pytest_cache .mypy_cache .ruff_cache .hypothesis
