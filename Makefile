# What a developer or a host runs on one machine. `make help` explains every target.
SHELL := /bin/bash
PROFILE ?= local
TARGET := target/x86_64-unknown-linux-gnu
STATIC := RUSTFLAGS="-C target-feature=+crt-static"
LAB := ./local/lab
FUZZ_SECONDS ?= 600
BENCH_PROFILE ?= release
BENCH_TARGET := target/$(BENCH_PROFILE:dev=debug)
BENCH := $(BENCH_TARGET)/leaderboard-bench
BENCH_LINES ?= target/bench/lines.jsonl
BENCH_FLAGS ?=

.DEFAULT_GOAL := help
.PHONY: help demo test test-core measure-scale measure-intake measure-failover measure-uploads cluster down status build static image images crds docs fmt lint deny bench bench-quick bench-report bench-results fuzz chart-test lab-test

help: ## Explain every target
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  %-14s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: ## Start everything on this machine, run one submission from SQS message to score, and check it (about 14 min the first time); REGISTRY=NAME: on the cluster of KUBECONFIG
	$(LAB) demo $(if $(REGISTRY),--registry $(REGISTRY))

test: ## Run all tests: formats, pure logic, API server, the real cluster (root, Linux; about 30 min the first time)
	$(LAB) test

test-core: ## Run the tests that need neither root nor a node
	$(LAB) test --core

measure-scale: ## Measure 200 submissions and 1,000 cancels against the stand-ins (half an hour; no root, no node)
	KUBEBUILDER_ASSETS="$${KUBEBUILDER_ASSETS:-$$($(LAB) tools etcd kube-apiserver kubectl)}" \
	LEADERBOARD_MINISTACK="$${LEADERBOARD_MINISTACK:-$$($(LAB) aws-venv)/ministack}" \
	cargo test --workspace --profile $(PROFILE) --test api -- --ignored --nocapture --test-threads 1 \
		two_hundred_submissions a_thousand_cancels a_hundred_cancels a_thousand_that_end_at_once

measure-intake: ## Measure the intake of 10,000 messages while controller and bridge are killed 50 times (10 min; no root, no node)
	KUBEBUILDER_ASSETS="$${KUBEBUILDER_ASSETS:-$$($(LAB) tools etcd kube-apiserver kubectl)}" \
	LEADERBOARD_MINISTACK="$${LEADERBOARD_MINISTACK:-$$($(LAB) aws-venv)/ministack}" \
	cargo test --workspace --profile $(PROFILE) --test api -- --ignored --nocapture --test-threads 1 \
		ten_thousand_messages

measure-failover: ## Measure how long the other replica takes to go on, ten ends of each kind (3 min; no root, no node)
	KUBEBUILDER_ASSETS="$${KUBEBUILDER_ASSETS:-$$($(LAB) tools etcd kube-apiserver kubectl)}" \
	LEADERBOARD_MINISTACK="$${LEADERBOARD_MINISTACK:-$$($(LAB) aws-venv)/ministack}" \
	cargo test --workspace --profile $(PROFILE) --test api -- --ignored --nocapture --test-threads 1 \
		the_leader_ends_ten_times

measure-uploads: ## Measure the controller's memory while it copies two uploaded files of 1 GiB (5 min and 8 GiB of memory; no root, no node)
	KUBEBUILDER_ASSETS="$${KUBEBUILDER_ASSETS:-$$($(LAB) tools etcd kube-apiserver kubectl)}" \
	LEADERBOARD_MINISTACK="$${LEADERBOARD_MINISTACK:-$$($(LAB) aws-venv)/ministack}" \
	cargo test --workspace --profile $(PROFILE) --test api -- --ignored --nocapture --test-threads 1 \
		two_uploaded_files_of_a_gibibyte

cluster: ## Start the one-node cluster and the AWS stand-in; prints the KUBECONFIG line to copy
	$(LAB) up

down: ## End everything that cluster, demo and test have started
	$(LAB) down

status: ## Say what of the cluster is up
	$(LAB) status

build: ## Build the operator
	cargo build --profile $(PROFILE) --workspace --bin leaderboard-operator --bin kubectl-leaderboard --bin evalai-stand-in

static: ## Build the programs that go into other images, statically
	$(STATIC) cargo build --release --target x86_64-unknown-linux-gnu -p leaderboard-runner
	$(STATIC) cargo build --profile $(PROFILE) --target x86_64-unknown-linux-gnu -p challenge-stand-in -p challenge-probe

image: build static ## Make the operator's image without a container engine and push it to the local registry
	$(LAB) image local/operator-image.toml --profile $(PROFILE)

images: image ## Make and push all images of the demo
	$(LAB) image local/challenge/images.toml --profile $(PROFILE)

crds: ## Generate crds/ from the types
	UPDATE_CRDS=1 cargo test --profile $(PROFILE) --workspace --lib -- crds

docs: ## Write docs/reference/probes.md and the tables of reasons in docs/states.md
	UPDATE_DOCS=1 cargo test --profile $(PROFILE) --workspace --lib -- documentation

fmt: ## Format the code
	cargo fmt --all

lint: ## Check format and lints
	cargo fmt --all --check
	cargo clippy --profile $(PROFILE) --workspace --all-targets -- -D warnings

deny: ## Check licenses, bans, sources and unused dependencies (needs cargo-deny and cargo-machete)
	cargo deny --offline check bans licenses sources
	cargo machete

chart-test: ## Check the chart: its values, what each of them renders, and what an API server makes of it
	$(LAB) chart-test

.PHONY: book chart-docs install-yaml
book: ## Make a book of the documents, target/book/index.html (builds mdBook the first time)
	$(LAB) book $(if $(SEARCH),--search)

chart-docs: ## Write docs/reference and the tables of the chart's values and of the metrics
	$(LAB) chart-docs

install-yaml: ## Print one file that installs the operator without Helm; ARGS are for helm template
	@$(LAB) install-yaml -- $(ARGS)

bench: ## Measure the operator next to the limit of its API server (30 min after the build; BENCH_FLAGS, BENCH_PROFILE)
	cargo build --locked --profile $(BENCH_PROFILE) -p leaderboard-operator -p leaderboard-bench --bins
	$(BENCH) run --tools "$$($(LAB) tools etcd kube-apiserver kube-controller-manager)" \
	    --operator $(BENCH_TARGET)/leaderboard-operator --profile $(BENCH_PROFILE) --out $(BENCH_LINES) $(BENCH_FLAGS)

bench-quick: ## The same with smaller numbers (5 min after the build)
	$(MAKE) bench BENCH_FLAGS="--quick $(BENCH_FLAGS)"

bench-report: ## Write tables and plots of docs/performance.md from what bench has measured
	$(BENCH) report $(BENCH_LINES)

bench-results: ## Measure the merge of results
	cargo bench -p leaderboard-results

fuzz: ## Fuzz the results code, FUZZ_SECONDS (600) for each target; needs cargo-fuzz and a C++ compiler
	@cargo fuzz --version >/dev/null 2>&1 || { echo "cargo-fuzz is missing: cargo install --locked cargo-fuzz" >&2; exit 1; }
	cd crates/results && for target in checkpoint merge; do \
	    cargo fuzz run -s none $$target fuzz/corpus/$$target -- -dict=fuzz/json.dict -max_total_time=$(FUZZ_SECONDS) \
	        -timeout=10 -rss_limit_mb=1024 -print_final_stats=1 || exit 1; \
	done

lab-test: ## Test local/ itself
	python3 -m unittest discover -s local/tests -t local
