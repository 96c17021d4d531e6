#!/usr/bin/env bash
# deploy/kubernetes on a real cluster, the one of kubectl's context: the blocks of its README as they stand, but for names, images
# and sizes; a run that is struck, and its curve against that of a run that nobody disturbed; a study; a run that cannot work.
#
#   LEARNER_IMAGE=... ACTOR_IMAGE=... tests/kubernetes.sh
#
# The images are what the cluster calls them, tags included. It needs JobSet, nodes with CPUs of one kind (curves are those of a kind),
# a default StorageClass that has ReadWriteMany (for the study), and 4 GiB of memory. Namespaces named popgym-test-* are made; what has
# not failed is removed.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

readonly namespace=popgym-test-$$ actors=2
# Some minutes on two cores, a checkpoint every 5 of its 250 epochs.
readonly configuration='env = "RepeatPreviousEasy"\nseed = 1\nsteps = 2_000_000\nthreads = 1\ncheckpoint_epochs = 5\n[memory]\nname = "mlp"'
readonly study='[run]\nsteps = 50_000\nthreads = 1\n[[product]]\nenvs = ["RepeatFirst"]\nmemories = ["mlp"]\nseeds = [0]'
work= space=default

say() { printf '%s %s\n' "$(date +%T)" "$*"; }
fail() {
    printf 'failed: %s\n' "$*" >&2
    exit 1
}

check() {
    local program image value
    for program in kubectl openssl python3; do
        command -v "$program" >/dev/null || fail "$program is not installed"
    done
    for image in LEARNER_IMAGE ACTOR_IMAGE; do
        value=${!image:-}
        [[ ${value##*/} == ?*:?* ]] || fail "$image is '$value', allowed is an image that the cluster can pull, with its tag"
    done
    kubectl version >/dev/null 2>&1 || fail "no cluster answers"
    kubectl get --raw /apis/jobset.x-k8s.io/v1alpha2 >/dev/null || fail "the cluster has no JobSet"
    say "$(kubectl config current-context): $(kubectl version 2>/dev/null | grep Server), $(kubectl get nodes --no-headers | wc -l) nodes"
}

# A wait only tells what hangs from a busy cluster.
wait_for() { # wait_for WHAT COMMAND...
    local end=$((SECONDS + 600)) what=$1
    shift
    until "$@"; do
        ((SECONDS < end)) || fail "waited too long for $what"
        sleep 0.5
    done
}

k() { kubectl --namespace "$space" "$@"; }

# ---------------------------------------------------------------------------------------------------------------------- README

# The README's block that has this text, for the namespace at hand.
block() { # block TEXT
    local found
    found=$(awk -v text="$1" '/^```/ { inside = !inside; if (!inside) { if (index(block, text)) { printf "%s", block; exit } block = "" } next }
        inside { block = block $0 "\n" }' "$root/deploy/kubernetes/README.md")
    [[ -n $found ]] || fail "README has no block with '$1'"
    here <<<"$found"
}
line() { # line TEXT: the one line of all blocks that has it
    local found
    found=$(awk -v text="$1" '/^```/ { inside = !inside } inside && index($0, text)' "$root/deploy/kubernetes/README.md")
    [[ $(wc -l <<<"$found") == 1 && -n $found ]] || fail "README has not one line with '$1'"
    here <<<"$found"
}
here() { sed "s/my-run/$space/g; s/my-study/$space/g; s/-n monitoring/-n $space/"; }
execute() { (cd "$work" && timeout 600 bash -euo pipefail) >>"$work/log" 2>&1 || { tail -n 30 "$work/log" >&2 && fail "a block of the README"; }; }

# What is smaller here than in the README: the run, what its pods ask for, how many they are; and the images.
overlay() { # overlay FILE TEXT KUSTOMIZATION...
    local dir=$work/deploy/kubernetes/$space
    printf '%b\n' "$2" >"$dir/$1"
    python3 - "$dir/kustomization.yaml" "$LEARNER_IMAGE" "$ACTOR_IMAGE" "${@:3}" <<'PYTHON'
import re, sys
path, learner, actor, *more = sys.argv[1:]
text = open(path).read()
for name, image in (("popgym-learner", learner), ("popgym-actor", actor)):
    repository, _, tag = image.rpartition(":")
    text = re.sub(rf"newName: \S+/{name}\n", f"newName: {repository}\n    newTag: '{tag}'\n", text)
open(path, "w").write("\n".join([text.rstrip("\n"), *more, ""]))
PYTHON
}

# A patch that lets the first container of a pod have little: it fits anywhere, and takes its time for a run.
little() { # little KIND PATH...
    local path
    printf '  - target:\n      kind: %s\n    patch: |-' "$1"
    for path in "${@:2}"; do
        printf '\n      - {op: replace, path: %s/template/spec/containers/0/resources, value: {requests: {cpu: 100m, memory: 256Mi}, limits: {cpu: "1", memory: 2Gi}}}' "$path"
    done
}

# --------------------------------------------------------------------------------------------------------------------- helpers

start_run() { # start_run NAMESPACE CONFIGURATION
    space=$1
    block certificates.sh | execute
    block "kustomization.yaml <<'END'" | sed "s/value: 8/value: $actors/; /^kubectl/d" | execute
    overlay run.toml "$2" "$(little JobSet /spec/replicatedJobs/{0,1}/template/spec)"
    block "kustomization.yaml <<'END'" | grep ^kubectl | execute
}

set_is() { [[ $(k get jobset popgym --output 'jsonpath={.status.terminalState}') == "$1" ]]; }

# The pods of a component that run and are ready.
ready() { # ready COMPONENT
    k get pods --selector "app.kubernetes.io/component=$1" --field-selector status.phase=Running --output json |
        python3 -c '
import json, sys
for pod in json.load(sys.stdin)["items"]:
    if "deletionTimestamp" not in pod["metadata"] and all(c["ready"] for c in pod["status"]["containerStatuses"]):
        print(pod["metadata"]["name"])'
}
one_ready() { [[ $(ready learner | grep -vxF "${1:-}" | wc -l) == 1 ]]; }

# A pod's answer, through kubectl.
get() { # get POD PORT PATH
    local forwarding port answer=1
    : >"$work/forward"
    kubectl --namespace "$space" port-forward "pod/$1" ":$2" >>"$work/forward" 2>&1 &
    forwarding=$!
    for _ in {1..50}; do
        port=$(sed -n 's/^Forwarding from 127.0.0.1:\([0-9]*\) .*/\1/p' "$work/forward")
        [[ -z $port ]] || break
        sleep 0.1
    done
    python3 - "http://127.0.0.1:$port/$3" 2>/dev/null <<'PYTHON' && answer=0
import sys, urllib.request
opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
print(opener.open(sys.argv[1], timeout=5).read().decode())
PYTHON
    kill "$forwarding" 2>/dev/null || true
    wait "$forwarding" 2>/dev/null || true
    return $answer
}
metric() { # metric POD PORT NAME OPERATOR NUMBER
    local value
    value=$(get "$1" "$2" metrics | awk -v name="$3" '$1 == name { print int($2) }')
    [[ -n $value ]] && test "$value" "$4" "$5"
}
learner_says() { # learner_says METRIC OPERATOR NUMBER
    local pod
    pod=$(ready learner)
    [[ -n $pod ]] && metric "$pod" 9100 "$@"
}
samples_of_index() {
    local pod
    pod=$(actor_of_index "$1")
    [[ -n $pod ]] && metric "$(basename "$pod")" 9101 popgym_actor_steps_total -gt 0
}

# --------------------------------------------------------------------------------------------------------------------- strikes

evict() {
    k create --raw "/api/v1/namespaces/$space/pods/$1/eviction" --filename - >/dev/null <<JSON
{"apiVersion": "policy/v1", "kind": "Eviction", "metadata": {"name": "$1", "namespace": "$space"}}
JSON
}

actor_of_index() { k get pods --selector "app.kubernetes.io/component=actor,batch.kubernetes.io/job-completion-index=$1" --output name | tail -n 1; }
another_actor() {
    local actor
    actor=$(actor_of_index 0)
    [[ -n $actor && $actor != "$1" ]]
}

strike() {
    local learner actor began
    wait_for "a learner" one_ready
    learner=$(ready learner)
    wait_for "its actors" learner_says popgym_learner_actors -eq "$actors"
    wait_for "a checkpoint" learner_says popgym_learner_env_steps_total -gt 60000

    say "an actor is lost"
    actor=$(actor_of_index 0)
    k delete "$actor" --grace-period 0 --force >/dev/null 2>&1
    wait_for "another actor in its place" another_actor "$actor"
    wait_for "the steps of that" samples_of_index 0

    say "one more actor"
    line '"completions":16' | sed "s/:16/:$((actors + 1))/g" | execute
    began=$SECONDS
    wait_for "its steps" samples_of_index "$actors"
    say "its pod samples after $((SECONDS - began)) s"

    say "the learner is evicted"
    [[ $(ready learner) == "$learner" ]] || fail "the learner did not outlive its actors"
    evict "$learner"
    wait_for "another learner" one_ready "$learner"
    wait_for "the return of its actors" learner_says popgym_learner_actors -eq $((actors + 1))
    learner=$(ready learner)
    # What an epoch has learned is kept when it is complete.
    wait_for "an epoch" learner_says popgym_learner_epochs_total -gt 0

    say "the learner is deleted"
    k delete pod "$learner" >/dev/null
    wait_for "another learner" one_ready "$learner"
    wait_for "the return of its actors" learner_says popgym_learner_actors -eq $((actors + 1))
}

# ----------------------------------------------------------------------------------------------------------------------- steps

# With all that is in it, as the README does it.
remove() {
    local began=$SECONDS
    if [[ $space == *-study ]]; then block "delete job " | execute; else block "delete jobset" | execute; fi
    say "it is removed, in $((SECONDS - began)) s"
}

fetch_run() { # fetch_run DEST
    block popgym-files: | execute
    mv "$work/runs/$space" "$1"
}

monitor() {
    if kubectl get --raw /apis/monitoring.coreos.com/v1 >/dev/null 2>&1; then
        line kubernetes/monitoring | execute
        block PrometheusRule | execute
        say "the cluster takes monitor and rules"
    else
        say "skipped: monitor and rules (the cluster has no Prometheus Operator)"
    fi
}

calm_run() {
    say "a run that nobody disturbs"
    start_run "$namespace-calm" "$configuration"
    monitor
    wait_for "its end" set_is Completed
    fetch_run "$work/calm"
    remove
}

struck_run() {
    say "a run that is struck"
    start_run "$namespace" "$configuration"
    strike
    wait_for "its end" set_is Completed
    wait_for "the end of its actors" no_actors
    say "it is complete"
    fetch_run "$work/struck"
    cmp "$work/calm/metrics.csv" "$work/struck/metrics.csv" || fail "the curve is not that of the undisturbed run"
    say "the same curve, $(wc -l <"$work/struck/metrics.csv") lines"
    python3 "$root/tests/resumed.py" 3 <"$work/struck/events.jsonl" || fail "not each new learner has gone on from a checkpoint"
    remove
}
no_actors() {
    local left
    left=$(ready actor) && [[ -z $left ]]
}

wrong_run() {
    say "a run that cannot work"
    start_run "$namespace-wrong" 'env = "Nowhere"'
    wait_for "its failure" set_is Failed
    k logs job/popgym-learner-0 | grep '^error: .*Nowhere' || fail "the learner does not say why"
    remove
}

removed_run() {
    say "a run that is removed while it goes on"
    start_run "$namespace-removed" "$configuration"
    wait_for "its actors" all_actors
    remove
}
all_actors() { [[ $(ready actor | wc -l) == "$actors" ]]; }

study() {
    say "a study of 3 trials"
    space=$namespace-study
    block 'study.toml <<' | sed "s/value: 12/value: 3/; /^kubectl/d" | execute
    overlay study.toml "$study" "$(little Job /spec)"
    block 'study.toml <<' | grep ^kubectl | execute
    wait_for "its end" study_is_complete
    block popgym-studies | execute
    [[ $(ls "$work/runs/$space"/trials/*/summary.json | wc -l) == 3 ]] || fail "there are not 3 trials"
    remove
}
study_is_complete() { [[ $(k get job popgym-study --output 'jsonpath={.status.succeeded}') == 3 ]]; }

main() {
    check
    work=$(mktemp -d)
    trap clean_up EXIT
    cp -r "$root/deploy" "$work/deploy"
    calm_run
    struck_run
    wrong_run
    removed_run
    study
    say "all of it holds"
}

clean_up() {
    local status=$?
    if ((status != 0)); then
        k get jobsets,jobs,pods >&2 || true
        k logs job/popgym-learner-0 --tail 20 >&2 || true
        printf 'namespaces %s* are left\n' "$namespace" >&2
    fi
    rm -rf "$work"
    exit "$status"
}

main
