# Every published number of this project, made again in one go:
#
#     make numbers JOBS=2
#
# Each finished part leaves an empty file in build/numbers/. After an interruption the same command continues, and so do
# the long commands; to make a part again remove its file. The order follows the dependencies: values are tuned, agents are
# trained and shipped, and only then everything is evaluated, on unseen episodes. `make -f docs/make/numbers.mk evaluated`
# evaluates the shipped agents without tuning or training them, and leaves out the tables of training runs where runs/ has none.

BIN := .venv/bin
JOBS ?= 2
DONE := build/numbers
SEEDS := 0-4

ENVIRONMENTS := ManeuveringTarget UavAutopilot RadarEsmTracking LooselyCoupledNavigation TightlyCoupledNavigation

room_ManeuveringTarget := maneuvering_target
room_UavAutopilot := uav_autopilot
room_RadarEsmTracking := radar_esm_tracking
room_LooselyCoupledNavigation := loosely_coupled_navigation
room_TightlyCoupledNavigation := tightly_coupled_navigation

agents_ManeuveringTarget := bptt bptt-small bptt-linear bptt-strongest ppo recurrent-ppo sac dqn kalman-net student ma-ukf rl-ukf
agents_UavAutopilot := bptt bptt-small bptt-linear bptt-strongest ppo sac kalman-net
agents_RadarEsmTracking := bptt bptt-small bptt-linear bptt-strongest ppo sac kalman-net
agents_LooselyCoupledNavigation := bptt bptt-small bptt-linear bptt-strongest ppo sac kalman-net
agents_TightlyCoupledNavigation := bptt ppo bptt-small bptt-linear bptt-strongest kalman-net

shipped_ManeuveringTarget := bptt bptt-small bptt-linear bptt-strongest ppo kalman-net student ma-ukf rl-ukf
shipped_UavAutopilot := bptt bptt-small bptt-strongest ppo kalman-net
shipped_RadarEsmTracking := bptt bptt-small bptt-linear bptt-strongest ppo kalman-net
shipped_LooselyCoupledNavigation := bptt bptt-small bptt-linear bptt-strongest ppo kalman-net
# Its kalman-net loses every track of the scenario `paper`, its bptt-linear costs nearly twice what bptt-small does: both are
# trained but not shipped.
shipped_TightlyCoupledNavigation := bptt ppo bptt-small bptt-strongest

# Its filters have 17 states, and one wrong step loses a track: fewer episodes, and agents behind the gate.
training_TightlyCoupledNavigation := --gated
training_TightlyCoupledNavigation-ppo := --residual-to fixed-robust-tuned
training_TightlyCoupledNavigation-kalman-net := --control kalman-net
episodes_TightlyCoupledNavigation := 400
crash_test_TightlyCoupledNavigation := --episodes 16 --steps 1000

PAPERS := imm-alpha-beta kalman-bucy-ins-gnss multi-hypothesis-ins-gnss radar-esm-class-fusion uav-autopilot-kalman

alone := $(filter evaluated,$(MAKECMDGOALS))
# Prerequisites of an evaluation, which has none alone.
after = $(if $(alone),,$(1))
# A part that needs training runs is left out without them, with a sentence.
with_runs = $(if $(alone),$(if $(wildcard $(1)),$(2),$(info $(2): left out, as there are no training runs $(1))),$(2))
episodes = $(or $(episodes_$(1)),2000)
trained = $(foreach agent,$(agents_$(1)),$(DONE)/train-$(1)-$(agent))
shipped = $(foreach environment,$(ENVIRONMENTS),$(DONE)/ship-$(environment))
# From a command's results to the record that pages are rendered from.
record := $(BIN)/python docs/make record
table := $(BIN)/python docs/make table
finish = @touch $@
$(shell mkdir -p $(DONE))

.PHONY: numbers programs tuned trained shipped evaluated
# Two long commands at once would share the same cores: each has its processes by JOBS.
.NOTPARALLEL:

numbers: programs tuned trained shipped evaluated

tuned: $(ENVIRONMENTS:%=$(DONE)/tune-%)
trained: $(foreach environment,$(ENVIRONMENTS),$(call trained,$(environment)))
shipped: $(shipped)
programs:
	@test -e $(DONE)/exported || command -v $(firstword $(cross)) > /dev/null || { echo "$(DONE)/exported needs $(firstword $(cross)): \
	  apt-get install gcc-arm-none-eabi, or leave it out by touch $(DONE)/exported" >&2; exit 1; }

evaluated: programs $(foreach name,$(ENVIRONMENTS),$(call with_runs,runs/$(name)/*-?,$(DONE)/seeds-$(name))) $(DONE)/benchmark \
  $(DONE)/coverage $(DONE)/flights $(DONE)/plain $(ENVIRONMENTS:%=$(DONE)/harm-%) $(ENVIRONMENTS:%=$(DONE)/stress-%) \
  $(DONE)/exported $(DONE)/budgets $(DONE)/pairs \
  $(call with_runs,runs/ManeuveringTarget/student-?,$(DONE)/students) $(call with_runs,runs/*/bptt-strongest-?,$(DONE)/strongest) \
  $(DONE)/drive $(DONE)/online $(DONE)/own_logs $(DONE)/sensing $(DONE)/loop $(DONE)/cold $(PAPERS:%=$(DONE)/paper-%)

# --- values: the shipped files contain their commands

$(DONE)/tune-%:
	$(BIN)/python -c "import json; [print(own['command']) for own in \
	  json.load(open('baselines/$(room_$*)/tuned.json')).values()]" | while read -r command; do \
	  $(BIN)/$$command --jobs $(JOBS) --out build/tuned < /dev/null || exit 1; done
	cp build/tuned/$*-v0.json baselines/$(room_$*)/tuned.json
	$(finish)

# --- agents

define training
$(DONE)/train-$(1)-$(2): $(DONE)/tune-$(1)
	$(BIN)/filtergym train filtergym/$(1)-v0 --algo $(2) $$(or $$(training_$(1)-$(2)),$$(training_$(1))) --seeds $(SEEDS) --jobs $(JOBS) --trust \
	  --out runs/$(1)/$(2)
	$$(finish)
endef
$(foreach environment,$(ENVIRONMENTS),$(foreach agent,$(agents_$(environment)),\
  $(eval $(call training,$(environment),$(agent)))))

define shipping
$(DONE)/ship-$(1): $(call trained,$(1))
	$(BIN)/python docs/make ship $(shipped_$(1):%=runs/$(1)/%-?) --trust
	$$(finish)
endef
$(foreach environment,$(ENVIRONMENTS),$(eval $(call shipping,$(environment))))

# --- evaluations

$(DONE)/seeds-%: $(call after,$(DONE)/ship-%)
	$(BIN)/python docs/make seeds runs/$*/*-? --scenario random --episodes $(call episodes,$*) --jobs $(JOBS) \
	  --out results/seeds/$*.json --into docs/records --trust
	$(finish)

# The second command alone makes the records of all environments anew from a finished benchmark, wherever it lies.
$(DONE)/benchmark: $(call after,$(shipped))
	$(BIN)/filtergym benchmark --full --half-width 2 --jobs $(JOBS) --out results/full
	$(record) results/full/results.json
	$(finish)

$(DONE)/coverage: $(call after,$(patsubst %,$(DONE)/ship-%,ManeuveringTarget LooselyCoupledNavigation TightlyCoupledNavigation))
	$(BIN)/python benchmarks/interval_coverage.py > build/coverage.txt
	$(table) build/coverage.txt --name interval_coverage \
	  --command "python benchmarks/interval_coverage.py"
	$(finish)

$(DONE)/flights: $(call after,$(DONE)/ship-ManeuveringTarget)
	$(BIN)/python -m pip install --quiet --no-deps traffic
	FILTERGYM_READ_MEMORY=1024 $(BIN)/python benchmarks/flights.py --out docs/data/flights.csv > build/flights.txt
	$(table) build/flights.txt --name flights_smoothed --name flights_recorded \
	  --command "FILTERGYM_READ_MEMORY=1024 python benchmarks/flights.py --out docs/data/flights.csv"
	$(finish)

$(DONE)/plain:
	$(BIN)/python benchmarks/plain_ppo.py --markdown --out build/plain_ppo.json > build/plain_ppo.txt
	$(table) build/plain_ppo.txt --name plain_ppo --command "python benchmarks/plain_ppo.py --markdown"
	$(BIN)/python benchmarks/plain_ppo.py --markdown --algo recurrent-ppo --envs 16 --seeds 1 --steps 50000 \
	  --out build/plain_recurrent_ppo.json > build/plain_recurrent_ppo.txt
	$(table) build/plain_recurrent_ppo.txt --name plain_recurrent_ppo --command \
	  "python benchmarks/plain_ppo.py --markdown --algo recurrent-ppo --envs 16 --seeds 1 --steps 50000"
	$(BIN)/python benchmarks/plain_ppo.py --markdown --algo sac --envs 16 --seeds 1 --steps 20000 \
	  --out build/plain_sac.json > build/plain_sac.txt
	$(table) build/plain_sac.txt --name plain_sac --command \
	  "python benchmarks/plain_ppo.py --markdown --algo sac --envs 16 --seeds 1 --steps 20000"
	$(finish)

$(DONE)/harm-%: $(call after,$(DONE)/ship-%)
	$(BIN)/python benchmarks/harm.py filtergym/$*-v0 --episodes $(call episodes,$*) > build/harm-$*.txt
	$(table) build/harm-$*.txt --name harm/$* \
	  --command "python benchmarks/harm.py filtergym/$*-v0 --episodes $(call episodes,$*)"
	$(finish)

crash_test = $(strip benchmarks/crash_test.py filtergym/$*-v0 $(crash_test_$*))

$(DONE)/stress-%: $(call after,$(DONE)/ship-%)
	$(BIN)/python $(crash_test) > build/stress-$*.txt
	$(table) build/stress-$*.txt --name stress/$* --command "python $(crash_test)" \
	  --note "23 alterations, of which some do not apply."
	$(finish)

cross = arm-none-eabi-gcc -mcpu=cortex-m4 -mthumb -mfpu=fpv4-sp-d16 -mfloat-abi=hard

$(DONE)/exported: $(call after,$(shipped))
	$(BIN)/python benchmarks/exported.py --cross "$(cross)" --out docs/data/exported.csv > build/exported.txt
	$(table) build/exported.txt --name exported_accuracy --name exported_cost \
	  --command "python benchmarks/exported.py --cross '$(cross)' --out docs/data/exported.csv"
	$(finish)

$(DONE)/budgets: $(call after,$(ENVIRONMENTS:%=$(DONE)/tune-%))
	$(BIN)/python benchmarks/training_budgets.py --runs runs/budgets > build/budgets.txt
	$(table) build/budgets.txt --name training_budgets --command "python benchmarks/training_budgets.py"
	$(finish)

$(DONE)/pairs: $(call after,$(shipped))
	$(BIN)/python benchmarks/front_pairs.py > build/pairs.txt
	$(table) build/pairs.txt --name front_pairs --command "python benchmarks/front_pairs.py"
	$(finish)

students = benchmarks/training_runs.py runs/ManeuveringTarget/student-? --against bptt --against semi-markov-9 --against semi-markov-15

$(DONE)/students: $(call after,$(DONE)/train-ManeuveringTarget-student $(DONE)/ship-ManeuveringTarget)
	$(BIN)/python $(students) > build/students.txt
	$(table) build/students.txt --name students --command "python $(students)"
	$(finish)

strongest = benchmarks/training_runs.py runs/*/bptt-strongest-? \
  --against semi-markov --against level-bank --against exact-bayes --against fault-bank --against fault-hypotheses

$(DONE)/strongest: $(call after,$(shipped))
	$(BIN)/python $(strongest) > build/strongest.txt
	$(table) build/strongest.txt --name strongest --command "python $(strongest)"
	$(finish)

$(DONE)/drive: $(call after,$(DONE)/ship-LooselyCoupledNavigation)
	$(BIN)/python benchmarks/drive_filters.py docs/data/drive.nc > build/drive.txt
	$(table) build/drive.txt --name drive_filters \
	  --command "python benchmarks/drive_filters.py docs/data/drive.nc"
	$(finish)

$(DONE)/online: $(call after,$(DONE)/ship-ManeuveringTarget)
	$(BIN)/python benchmarks/online.py > build/online.txt
	$(table) build/online.txt --name online_time --command "python benchmarks/online.py"
	$(finish)

$(DONE)/own_logs:
	$(BIN)/python benchmarks/own_logs.py > build/own_logs.txt
	$(table) build/own_logs.txt --name own_logs --command "python benchmarks/own_logs.py"
	$(finish)

$(DONE)/loop:
	$(BIN)/python benchmarks/estimation_in_the_loop.py fixed trained time > build/loop.txt
	$(table) build/loop.txt --name loop_fixed --name loop_trained --name loop_steered --name loop_time --command "python benchmarks/estimation_in_the_loop.py fixed trained time"
	$(finish)

$(DONE)/sensing:
	for seed in 0 1; do (cd docs/examples && $(CURDIR)/$(BIN)/filtergym train budgeted_sensing:mine/BudgetedSensing-v0 --algo ppo \
	  --scenario narrow --steps 640000 --seed $$seed --config budgeted_sensing.yml --out runs/ppo-$$seed); done
	$(BIN)/python benchmarks/budgeted_sensing.py --agent docs/examples/runs/ppo-0 --agent docs/examples/runs/ppo-1 > build/sensing.txt
	$(table) build/sensing.txt --name budgeted_sensing --name budgeted_schedules \
	  --command "python benchmarks/budgeted_sensing.py --agent docs/examples/runs/ppo-0 --agent docs/examples/runs/ppo-1"
	$(finish)

$(DONE)/cold:
	$(BIN)/python benchmarks/cold.py --record
	$(finish)

$(DONE)/paper-%:
	$(BIN)/filtergym reproduce $* --jobs $(JOBS) --out docs/reproductions/$*
	$(finish)
