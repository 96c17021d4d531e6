#!/usr/bin/env bash
# deploy/slurm on a real Slurm: a controller and four node daemons of this machine in a temporary directory, real jobs, real
# failures. Debian: apt-get install slurmctld slurmd slurm-client munge openssl.
#
#   tests/slurm.sh CASE PROGRAMS      CASE: run, node, limit, cancel, actors or study; PROGRAMS: directory of learner and actor
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
readonly root nodes=4
PATH+=:/usr/sbin:/sbin

# As long as no epoch: a few seconds on two cores, a checkpoint every 3 of its 20 epochs.
readonly flags=(--memory mlp --steps 160000 --checkpoint-epochs 3 --threads 1 --rows 128)
# What a job is on this cluster, which has no GPU.
readonly small=(--gres=none --cpus-per-task=1 --mem-per-cpu=100M)

say() { printf '%s %s\n' "$(date +%T)" "$*"; }
fail() {
    printf 'failed: %s\n' "$*" >&2
    exit 1
}

# until_true WHAT COMMAND...: waits for it. The deadline only tells a test that hangs from one on a busy machine.
until_true() {
    local end=$((SECONDS + 300)) what=$1
    shift
    until "$@"; do
        ((SECONDS < end)) || fail "waited in vain: $what"
        sleep 0.1
    done
}

# ---- the cluster ----

free_ports() { # free_ports COUNT: the first of so many in a row that nobody listens at
    local first port
    while :; do
        first=$((20000 + RANDOM % 10000))
        for ((port = first; port < first + $1; port++)); do
            ! (exec 3<>"/dev/tcp/127.0.0.1/$port") 2>/dev/null || continue 2
        done
        printf '%s\n' "$first"
        return
    done
}

configure() {
    local port user
    port=$(free_ports $((nodes + 1)))
    user=$(id -un)
    cat >"$dir/slurm.conf" <<CONF
ClusterName=test
SlurmctldHost=localhost
SlurmctldPort=$port
AuthType=auth/munge
AuthInfo=socket=$dir/munge/socket
SlurmUser=$user
SlurmdUser=$user
StateSaveLocation=$dir/state
SlurmdSpoolDir=$dir/spool/%n
SlurmctldPidFile=$dir/slurmctld.pid
SlurmdPidFile=$dir/%n.pid
SlurmctldLogFile=$dir/slurmctld.log
SlurmdLogFile=$dir/%n.log
SlurmdParameters=config_overrides
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SchedulerType=sched/backfill
SchedulerParameters=bf_interval=1,sched_interval=1,sched_min_interval=0
SlurmdTimeout=300
KillWait=30
MinJobAge=3600
ReturnToService=2
MailProg=/bin/true
NodeName=n[1-$nodes] NodeHostName=localhost NodeAddr=127.0.0.1 Port=$((port + 1))-$((port + nodes)) CPUs=8 RealMemory=16000
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP PriorityTier=1 GraceTime=20
PartitionName=urgent Nodes=ALL MaxTime=INFINITE State=UP PriorityTier=2
CONF
}

start_node() { slurmd -f "$dir/slurm.conf" -N "$1"; }
idle_nodes() { [[ $(sinfo --noheader --states=idle --Node --partition=main 2>/dev/null | wc -l) -eq $nodes ]]; }

start_cluster() {
    local program node
    for program in munged slurmctld slurmd sbatch openssl; do
        command -v "$program" >/dev/null ||
            fail "missing: $program (Debian: apt-get install slurmctld slurmd slurm-client munge openssl)"
    done
    dir=$(mktemp -d)
    trap stop_cluster EXIT
    chmod 755 "$dir"
    mkdir -m 700 "$dir/munge"
    mkdir -p "$dir/state" "$dir/spool"/n{1..4}
    (umask 077 && head -c 128 /dev/urandom >"$dir/munge/key")
    export SLURM_CONF=$dir/slurm.conf
    configure
    # --force: it does not like directories below /tmp.
    munged --force --key-file "$dir/munge/key" --socket "$dir/munge/socket" --pid-file "$dir/munged.pid" \
        --log-file "$dir/munge/log" --seed-file "$dir/munge/seed" 2>/dev/null
    slurmctld -f "$dir/slurm.conf"
    for node in n1 n2 n3 n4; do
        start_node "$node"
    done
    until_true "a cluster of $nodes idle nodes" idle_nodes
    say "a cluster of $nodes nodes is up"
}

# of_cluster WORD: processes of this cluster's jobs whose environment has this word.
of_cluster() {
    { grep -lzxF -- "SLURM_CONF=$dir/slurm.conf" /proc/[0-9]*/environ 2>/dev/null | xargs -r grep -lzxF -- "$1" 2>/dev/null || true; } |
        tr -cd '0-9\n'
}

# of_name NAME: those of this name.
of_name() {
    of_cluster "POPGYM_BIN=$POPGYM_BIN" | sed 's|.*|/proc/&/comm|' | { xargs -r grep -lxF -- "$1" 2>/dev/null || true; } |
        tr -cd '0-9\n'
}

# signal SIGNAL NAME: to all of this name, of which one may just have ended.
signal() { of_name "$2" | xargs -r kill "-$1" 2>/dev/null || true; }

stop_cluster() {
    local status=$?
    set +e
    if ((status != 0)); then
        squeue
        tail -n 40 "$dir"/slurmctld.log "$dir"/*.out "$dir"/runs/*.slurm/*.log
    fi >&2
    trap '' TERM
    scancel --user="$(id -un)" 2>/dev/null
    for ((i = 0; i < 100; i++)); do
        [[ -n $(squeue --noheader 2>/dev/null) ]] || break
        sleep 0.1
    done
    # shellcheck disable=SC2046 # numbers
    kill $(cat "$dir"/*.pid) 2>/dev/null
    # shellcheck disable=SC2046
    kill -9 $(of_cluster "POPGYM_BIN=$POPGYM_BIN" | grep -vx $$) 2>/dev/null
    rm -rf "$dir" || { sleep 1 && rm -rf "$dir"; }
}

# A node whose power fails: its daemon, those of its steps, and all that they run, at once; the controller is told.
kill_node() { # kill_node NODE
    local daemons=() tasks pid parent
    say "node $1 fails"
    mapfile -t tasks < <(of_cluster "SLURMD_NODENAME=$1")
    for pid in "${tasks[@]}"; do
        parent=$(awk '/^PPid:/ { print $2 }' "/proc/$pid/status" 2>/dev/null) || continue
        [[ $(cat "/proc/$parent/comm" 2>/dev/null) != slurmstepd ]] || daemons+=("$parent")
    done
    # The daemons first, so that none of them tells how its tasks ended.
    kill -9 "$(cat "$dir/$1.pid")" "${daemons[@]}" "${tasks[@]}" 2>/dev/null || true
    scontrol update NodeName="$1" State=DOWN Reason="power failure"
}

mend_node() { # mend_node NODE
    start_node "$1"
    until_true "node $1 in service" in_service "$1"
}
in_service() { [[ $(sinfo --noheader --nodes="$1" --format=%T) =~ ^(idle|planned|mixed|allocated)$ ]]; }

# ---- jobs ----

# submit NAME OPTIONS...: sbatch; its output goes to NAME.out, the job's number to `job`.
submit() {
    job=$(sbatch --parsable --output="$dir/$1.out" "${@:2}")
    say "job $job: $1"
}

field() { # field JOB NAME: of what Slurm says of it
    scontrol show job "$1" | tr ' ' '\n' | sed -n "s/^$2=//p" | head -n 1
}
state_is() { [[ $(field "$1" JobState) == "$2" ]]; }

# Slurm puts a job that it queues again off for two minutes.
hurry() {
    local part
    for part in $(squeue --noheader --states=PENDING --format=%A); do
        [[ $(field "$part" Reason) != BeginTime ]] || scontrol update JobId="$part" StartTime=now 2>/dev/null || true
    done
}

completed() { # completed JOB: whether it is; no job that failed ever will be
    hurry
    ! [[ $(field "$1" JobState) =~ FAILED|CANCELLED|TIMEOUT|NODE_FAIL|OUT_OF_MEMORY ]] || fail "job $1 is $(field "$1" JobState)"
    state_is "$1" COMPLETED
}
expect_complete() { until_true "job $1 complete" completed "$1"; }

# ---- runs ----

epochs() { { tail -n +2 "$dir/$1/metrics.csv" 2>/dev/null || true; } | wc -l; }
reached() { (($(epochs "$1") >= $2)); }
reaches() { until_true "$2 epochs of $1" reached "$1" "$2"; }

# events RUN EVENT: lines of its account, whole ones.
events() { grep "\"event\":\"$2\".*}\$" "$dir/$1/events.jsonl" || true; }
# samplers RUN: nodes whose actors sampled for it.
samplers() { events "$1" accepted | sed 's/.*"actor":"\([^."]*\)\..*/\1/' | sort -u; }

# The run that nothing disturbs.
undisturbed() {
    "$POPGYM_BIN/learner" train --out "$dir/undisturbed" "${flags[@]}" --actors 1 >"$dir/undisturbed.out" 2>&1 ||
        fail "the undisturbed run: $(tail -n 1 "$dir/undisturbed.out")"
    say "the undisturbed run has $(epochs undisturbed) epochs"
}
expect_same_curve() { # expect_same_curve RUN
    cmp "$dir/undisturbed/metrics.csv" "$dir/$1/metrics.csv" || fail "$1/metrics.csv is not the undisturbed run's"
    say "metrics.csv is the undisturbed run's, byte for byte"
}
expect_no_secrets() { # expect_no_secrets RUN
    local left
    left=$(find "$dir/$1.slurm" -mindepth 1 ! -name '*.log' ! -name complete)
    [[ -z $left ]] || fail "left after the job: $left"
}
expect() { # expect WHAT IS WANTED
    [[ $2 == "$3" ]] || fail "$1 is '$2', expected '$3'"
}

# ---- cases ----

# As in the manual: from the checkout, in two parts on three nodes.
case_run() {
    undisturbed
    cd "$root"
    unset POPGYM_ROOT
    submit run "${small[@]}" : --ntasks=4 --nodes=2 --mem-per-cpu=100M deploy/slurm/train.sbatch "$dir/runs/first" "${flags[@]}"
    reaches runs/first 2
    expect "mode of the job's secrets" "$(stat -c %a "$dir/runs/first.slurm/job-$job")" 700
    expect "secrets that others can read" "$(find "$dir/runs/first.slurm/job-$job" \( -name '*.key' -o -name token \) -perm /077)" ""
    grep -q '^https://127.0.0.1:' "$dir/runs/first.slurm/current/address" || fail "no https:// address"
    expect_complete "$job"
    expect "nodes that sampled" "$(samplers runs/first | wc -l)" 2
    expect_same_curve runs/first
    expect_no_secrets runs/first
    for file in config.toml summary.json curve.svg events.jsonl; do
        [[ -s $dir/runs/first/$file ]] || fail "the run has left no $file"
    done
    # Once more: there is nothing left to do.
    submit again "${small[@]}" : --mem-per-cpu=100M deploy/slurm/train.sbatch "$dir/runs/first" "${flags[@]}"
    expect_complete "$job"
    grep -q "already complete" "$dir/again.out" || fail "$(cat "$dir/again.out")"
    expect_same_curve runs/first
}

# The learner's node fails, then one of its actors'.
case_node() {
    undisturbed
    submit node "${small[@]}" : --ntasks=2 --nodes=2 --mem-per-cpu=100M "$root/deploy/slurm/train.sbatch" "$dir/runs/node" "${flags[@]}"
    reaches runs/node 4
    node=$(field "$job" BatchHost)
    kill_node "$node"
    until_true "a second start" starts runs/node 2
    expect "Restarts" "$(field "$job" Restarts)" 1
    [[ $(field "$job" BatchHost) != "$node" ]] || fail "the learner is again on $node, which is down"
    mend_node "$node"
    reaches runs/node 9
    node=$(field $((job + 1)) NodeList)
    kill_node "$(scontrol show hostnames "$node" | tail -n 1)"
    expect_complete "$job"
    expect "Restarts" "$(field "$job" Restarts)" 2
    expect "starts of the learner" "$(events runs/node started | wc -l)" 3
    expect_same_curve runs/node
    expect_no_secrets runs/node
}
starts() {
    hurry
    (($(events "$1" started | wc -l) >= $2))
}

# The time limit comes in the middle of a run: its state is saved, and the job queued again.
case_limit() {
    undisturbed
    # Slurm sends the signal up to a minute earlier than it is told to.
    submit limit "${small[@]}" --time=3 --signal=B:USR1@60 : --time=3 --ntasks=2 --mem-per-cpu=100M "$root/deploy/slurm/train.sbatch" \
        "$dir/runs/limit" "${flags[@]}"
    reaches runs/limit 2
    # So that it does not end before.
    signal STOP actor
    until_true "the job queued again" state_is "$job" PENDING
    signal CONT actor
    saved=$(epochs runs/limit)
    [[ -d $dir/runs/limit/checkpoints/epoch-$(printf %06d "$saved") ]] || fail "no checkpoint of epoch $saved"
    grep -q '"stopped_by": "interrupt"' "$dir/runs/limit/summary.json" || fail "the learner was not asked to end"
    scontrol update JobId="$job" TimeLimit=60
    scontrol update JobId="$((job + 1))" TimeLimit=60
    expect_complete "$job"
    expect "Restarts" "$(field "$job" Restarts)" 1
    expect_same_curve runs/limit
    # A job that gets nowhere would be queued again for ever.
    submit stuck "${small[@]}" "$root/deploy/slurm/learner.sbatch" "$dir/runs/stuck" "${flags[@]}"
    until_true "a learner that listens" test -e "$dir/runs/stuck.slurm/current"
    scancel --batch --signal=USR1 "$job"
    until_true "a job that failed" state_is "$job" FAILED
    grep -q "error: nothing was saved" "$dir/stuck.out" || fail "$(cat "$dir/stuck.out")"
    expect_no_secrets runs/stuck
}
# A job that is cancelled saves the run's state and is not queued again; the same command goes on.
case_cancel() {
    undisturbed
    command=(submit cancel "${small[@]}" : --ntasks=2 --mem-per-cpu=100M "$root/deploy/slurm/train.sbatch" "$dir/runs/cancel" "${flags[@]}")
    "${command[@]}"
    reaches runs/cancel 4
    scancel "$job"
    until_true "the job's end" ended "$job"
    expect "JobState" "$(field "$job" JobState)" CANCELLED
    saved=$(epochs runs/cancel)
    [[ -d $dir/runs/cancel/checkpoints/epoch-$(printf %06d "$saved") ]] || fail "no checkpoint of epoch $saved"
    until_true "the job's secrets gone" absent "$dir/runs/cancel.slurm/job-$job"
    expect_no_secrets runs/cancel
    "${command[@]}"
    expect_complete "$job"
    expect_same_curve runs/cancel
}
absent() { [[ ! -e $1 ]]; }
ended() { [[ -z $(squeue --noheader --jobs "$1" 2>/dev/null) ]]; }

# Learner and actors as jobs of their own: actors come, are preempted, lose their node, are killed; the learner is killed.
case_actors() {
    undisturbed
    export POPGYM_TLS=off
    submit learner "${small[@]}" --nodelist=n1 "$root/deploy/slurm/learner.sbatch" "$dir/runs/actors" "${flags[@]}"
    learner=$job
    submit actors --array=1-2 --nodelist=n2 --mem-per-cpu=100M "$root/deploy/slurm/actors.sbatch" "$dir/runs/actors"
    actors=$job
    reaches runs/actors 2
    submit more --array=1 --ntasks=2 --nodelist=n3 --mem-per-cpu=100M "$root/deploy/slurm/actors.sbatch" "$dir/runs/actors"
    more=$job
    until_true "actors on n3" sampled_by n3
    submit urgent --partition=urgent --exclusive --nodelist=n3 --wrap=true
    until_true "preempted actors queued again" state_is "${more}_1" PENDING
    expect_complete "$job"
    until_true "their second start" started_again "${more}_1"
    kill_node n2
    reaches runs/actors "$(($(epochs runs/actors) + 2))"
    say "a learner is killed"
    address=$(cat "$dir/runs/actors.slurm/current/address")
    signal 9 learner
    reaches runs/actors "$(($(epochs runs/actors) + 2))"
    expect "the learner's address" "$(cat "$dir/runs/actors.slurm/current/address")" "$address"
    say "an actor is killed"
    kill -9 "$(of_name actor | sed -n 1p)"
    mend_node n2
    expect_complete "$learner"
    expect "Restarts of the learner" "$(field "$learner" Restarts)" 0
    expect "starts of the learner" "$(events runs/actors started | wc -l)" 2
    expect "nodes that sampled" "$(samplers runs/actors | tr '\n' ' ')" "n2 n3 "
    expect_same_curve runs/actors
    expect_no_secrets runs/actors
    # They leave by themselves; those that were queued again find a run that is complete.
    for job in "$more" "$actors"_1 "$actors"_2; do
        expect_complete "$job"
    done
}

sampled_by() { samplers runs/actors | grep -qx "$1"; }
started_again() {
    hurry
    state_is "$1" RUNNING && [[ $(field "$1" Restarts) -eq 1 ]]
}

# Two arrays for one study, at the same time; then a node fails.
case_study() {
    cat >"$dir/study.toml" <<'TOML'
[run]
steps = 30000
rows = 128
checkpoint_epochs = 2
[[product]]
envs = ["RepeatPreviousEasy", "RepeatFirstEasy"]
memories = ["mlp"]
seeds = [0, 1]
[[override]]
envs = ["RepeatFirstEasy"]
run = { steps = 120000 }
TOML
    cd "$dir"
    submit one --array=0-3 --mem-per-cpu=100M "$root/deploy/slurm/study.sbatch" study.toml study
    one=$job
    submit two --array=0-3 --mem-per-cpu=100M "$root/deploy/slurm/study.sbatch" study.toml study
    two=$job
    # Of two tasks for a trial one has it, and the other says so and fails.
    until_true "four tasks that found their trial taken" taken 4
    until_true "trial 3 on its way" reached study/trials/0003-RepeatFirstEasy-mlp-seed1 1
    until_true "trial 2 on its way" reached study/trials/0002-RepeatFirstEasy-mlp-seed0 3
    # So that none ends before.
    signal STOP actor
    # Somebody asks for the last task to be queued again, whose number is that of the array: the others stay as they are.
    last=$one
    state_is "${one}_3" RUNNING || last=$two
    scancel --batch --signal=USR1 "${last}_3"
    until_true "the last task queued again" state_is "${last}_3" PENDING
    for job in "${one}"_{0..2} "${two}"_{0..2}; do
        expect "Restarts of $job" "$(field "$job" Restarts)" 0
    done
    victim=$one
    state_is "${one}_2" RUNNING || victim=$two
    kill_node "$(field "${victim}_2" BatchHost)"
    signal CONT actor
    for trial in 0 1 2 3; do
        until_true "trial $trial" study_tasks_ended "$trial"
        states=$(printf '%s\n' "$(field "${one}_$trial" JobState)" "$(field "${two}_$trial" JobState)" | sort | tr '\n' ' ')
        expect "states of the two tasks for trial $trial" "$states" "COMPLETED FAILED "
    done
    taken 4 || fail "a task came to a trial that was taken, after the node had failed"
    ! ls study/trials/*.failures 2>/dev/null || fail "trials have failed"
    expect "trials that are done" "$("$POPGYM_BIN/learner" study list study.toml --out study | grep -c ' done$')" 4
    # One start for the node that failed, and for the last task one more.
    expect "starts of trial 2" "$(events study/trials/0002-RepeatFirstEasy-mlp-seed0 started | wc -l)" 2
    (($(events study/trials/0003-RepeatFirstEasy-mlp-seed1 started | wc -l) >= 2)) || fail "trial 3 did not start again"
    "$POPGYM_BIN/learner" study run study.toml --out alone --jobs 2 >/dev/null 2>&1
    for trial in study/trials/*/metrics.csv; do
        cmp "$trial" "alone/${trial#study/}" || fail "$trial is not the undisturbed trial's"
    done
}
taken() { [[ $(cat one.out two.out 2>/dev/null | grep -c "run by other processes") -eq $1 ]]; }
study_tasks_ended() {
    hurry
    ended "${one}_$1" && ended "${two}_$1"
}

[[ $# -eq 2 && $1 =~ ^(run|node|limit|cancel|actors|study)$ ]] || {
    sed -n 's/^#   \(tests.*\)/usage: \1/p' "$0" >&2
    exit 2
}
POPGYM_BIN=$(cd "$2" && pwd)
export POPGYM_BIN POPGYM_ROOT=$root
# Of whoever calls this, perhaps from a job.
unset POPGYM_TLS POPGYM_HOST POPGYM_GRACE POPGYM_WAIT "${!SLURM_@}" "${!SBATCH_@}"
start_cluster
"case_$1"
say "ok: $1"
