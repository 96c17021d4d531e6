# make help lists what there is. Every target does what it needs first, so any of them works in a fresh clone.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

CARGO ?= cargo
# The versions in Cargo.lock, exactly.
CARGO_FLAGS ?= --locked
# For the learner, on top of what `make train` gives it.
ARGS ?=
# Of make fuzz: which targets, and seconds for each.
FUZZ_TARGETS ?= wire weights checkpoint configuration study recording
SECONDS_EACH ?= 1800

# Another libtorch of the user's would be compiled against but not found at run time.
unexport LIBTORCH LIBTORCH_INCLUDE LIBTORCH_LIB LIBTORCH_STATIC LIBTORCH_USE_PYTORCH

.PHONY: help setup build train test soak slurm containers kubernetes lint bench fuzz up down logs clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: ## fetch libtorch into the user's cache and link it here
	@deploy/setup.sh

build: setup ## release binaries: target/release/learner and target/release/actor
	$(CARGO) build $(CARGO_FLAGS) --release -p popgym-learner -p popgym-actor

train: build ## train until the agent has mastered its task; more options with ARGS="..."
	target/release/learner train --stop-at-mmer 0.95 $(ARGS)

test: setup ## all tests
	$(CARGO) test $(CARGO_FLAGS) --workspace

soak: setup ## the long forms of tests: 200 random faults in a run, hostile actors for minutes, with their figures
	POPGYM_SOAK=1 $(CARGO) test $(CARGO_FLAGS) --workspace --test soak --test floods -- --nocapture --test-threads 1

slurm: setup ## deploy/slurm on a real Slurm, where Debian's slurmctld, slurmd, slurm-client and munge are installed
	@missing=; \
	for program in munged slurmctld slurmd sbatch; do \
		PATH="$$PATH:/usr/sbin" command -v "$$program" >/dev/null || missing+=" $$program"; \
	done; \
	if [[ -z $$missing ]]; then \
		$(CARGO) test $(CARGO_FLAGS) --workspace --test slurm -- --ignored --nocapture --test-threads 1; \
	else \
		echo "skipped: tests on a real Slurm (not installed:$$missing)"; \
	fi

containers: setup ## deploy/compose.yaml in a Docker engine, with images built on bases that are made for it
	POPGYM_CONTAINERS=1 $(CARGO) test $(CARGO_FLAGS) --workspace --test containers -- --nocapture

kubernetes: ## deploy/kubernetes on the cluster of kubectl's context; LEARNER_IMAGE and ACTOR_IMAGE name images that it can pull
	@tests/kubernetes.sh

lint: setup ## formatting, clippy, and licences and advisories where cargo-deny is installed
	$(CARGO) fmt --all --check
	$(CARGO) clippy $(CARGO_FLAGS) --workspace --all-targets -- -D warnings
	@if ! $(CARGO) deny --version >/dev/null 2>&1; then \
		echo "skipped: cargo deny check (cargo-deny is not installed)"; \
	elif $(CARGO) deny fetch db; then \
		$(CARGO) deny check; \
	else \
		echo "skipped: advisories (their database cannot be reached)"; \
		$(CARGO) deny check bans licenses sources; \
	fi

bench: setup ## all benchmarks
	$(CARGO) bench $(CARGO_FLAGS) --workspace

fuzz: setup ## fuzz what reads from outside, SECONDS_EACH=1800 for each target; needs cargo-fuzz
	@$(CARGO) fuzz --version >/dev/null 2>&1 || { \
		echo "cargo-fuzz is not installed: cargo install --locked cargo-fuzz" >&2; exit 1; }
	for target in $(FUZZ_TARGETS); do \
		mkdir -p ".cache/fuzz/$$target"; \
		OMP_NUM_THREADS=1 LD_LIBRARY_PATH="$(CURDIR)/.libtorch/lib" \
		$(CARGO) fuzz run --fuzz-dir tests/fuzz "$$target" --features libfuzzer -s none \
			".cache/fuzz/$$target" "tests/fuzz/corpus/$$target" -- \
			-max_total_time=$(SECONDS_EACH) -timeout=20 -rss_limit_mb=4096; \
	done

up: ## a learner and actors in containers, Prometheus and Grafana if they can be had; deploy/.env has the settings
	@deploy/compose.sh up --detach --build
	@for service in prometheus grafana; do \
		deploy/compose.sh up --detach "$$service" || \
			echo "without $$service: see above; deploy/.env may name another image or address"; \
	done

logs: ## what the containers say
	@deploy/compose.sh logs --follow --tail 100

down: ## remove the containers; runs and secrets stay
	@deploy/compose.sh down

clean: ## remove what was built here; the cached libtorch stays
	$(CARGO) clean
	rm -f .libtorch
