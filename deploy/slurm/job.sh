# shellcheck shell=bash
# What the scripts beside it share; they source it.

say() { printf '%s %s\n' "$(date +%FT%T)" "$*"; }
fail() { # fail STATUS WORDS...: 1 it failed, 2 it was called wrongly
    printf 'error: %s\n' "${*:2}" >&2
    exit "$1"
}

# program NAME: where it is. A job runs one of them on each of its nodes, so that must be a directory that all nodes share.
program() {
    local path=${POPGYM_BIN:-$root/target/release}/$1
    [[ -x $path ]] ||
        fail 2 "there is no program $path: make build, or set POPGYM_BIN to the directory of learner and actor, on a file system that all nodes share"
    printf '%s\n' "$path"
}

# number NAME DEFAULT LEAST MOST: the value of a variable that is a number.
number() {
    local value=${!1:-$2}
    if ! [[ $value =~ ^[0-9]{1,9}$ ]] || ((10#$value < $3 || 10#$value > $4)); then
        fail 2 "$1 is '$value', allowed is $3 to $4"
    fi
    printf '%d\n' "$((10#$value))"
}

# epochs FILE...: rows below the heads of these files, which are metrics.csv; none where there is no file.
epochs() { { tail -q -n +2 -- "$@" 2>/dev/null || true; } | wc -l; }

# saved DIR...: epochs of the newest checkpoint in these run directories; 0 where there is none. What metrics.csv has beyond it is
# done again.
saved() {
    local dir
    for dir in "$@"; do
        ls -- "$dir/checkpoints" 2>/dev/null || true
    done | sed -n 's/^epoch-0*\([0-9][0-9]*\)$/\1/p' | sort -n | tail -n 1 | grep . || echo 0
}

child= # the process that this job is about
told=  # why it was told to end

# SIGUSR1 comes to this shell alone, before the time limit (--signal) and when somebody asks for it; SIGTERM comes to all of
# the job's processes, when it is cancelled or preempted. A second SIGTERM would keep a learner from saving.
listen_for_signals() {
    trap 'end SIGUSR1' USR1
    trap 'told=${told:-SIGTERM}' TERM
}
end() {
    [[ -z $told ]] || return 0
    told=$1
    say "$told; asking process ${child:-(none yet)} to save and end"
    [[ -z $child ]] || kill -TERM "$child" 2>/dev/null || true
}

# attend: waits for the child, through all signals; its status.
attend() {
    local status
    while :; do
        wait "$child" && status=0 || status=$?
        kill -0 "$child" 2>/dev/null || break
    done
    # It may have ended just when a signal came, whose number was the status then.
    wait "$child" && status=0 || status=$?
    child=
    return "$status"
}

# is_wanted: whether Slurm has not ended this job: one that was cancelled or preempted is no longer running, though its
# processes are.
is_wanted() {
    local state
    state=$(squeue --noheader --jobs "$SLURM_JOB_ID" --format '%A %T' | awk -v id="$SLURM_JOB_ID" '$1 == id { print $2 }')
    [[ $state == RUNNING ]]
}

# queue_again: what becomes of the job is Slurm's business then. Of an array it is this task alone: the number of its last task
# is that of the whole array, too.
queue_again() {
    local job=$SLURM_JOB_ID
    [[ -z ${SLURM_ARRAY_JOB_ID:-} ]] || job=${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID
    scontrol requeue "$job"
}

# go_on_later EPOCHS DIR...: gives the nodes back and queues the job again, unless it was cancelled, or has saved no more than
# as many epochs: then it would do so for ever. Exits, with status 0 where the job goes on.
go_on_later() {
    local before=$1
    shift
    if ! is_wanted; then
        say "ended by Slurm ($told); the same command goes on from the checkpoint"
        exit 143
    fi
    (($(saved "$@") > before)) ||
        fail 1 "nothing was saved since this job started ($told): not queued again. Is the time limit shorter than an epoch, the disk full, or does no actor work?"
    say "queueing the job again: it goes on from the checkpoint"
    queue_again ||
        fail 1 "the job may not be queued again; the same command goes on from the checkpoint"
    exit 0
}
