#!/usr/bin/env bash
# One actor of a run whose learner is a job (learner.sbatch, train.sbatch): waits for the learner, works for it, and looks for
# it again when it is gone, until the run is complete. The jobs call it; by hand, on any node that shares the file system:
#
#   deploy/slurm/actor.sh RUN_DIR
#
#   POPGYM_BIN    directory of the programs                       (default: target/release of the checkout)
#   POPGYM_WAIT   give up after as many seconds without a learner  (default: 3600)
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
# shellcheck source=deploy/slurm/job.sh
. "$root/deploy/slurm/job.sh"

# It fails for good after as many failures in a row, each within the time that an actor looks for its learner.
readonly attempts=5 retry=60

[[ $# -eq 1 && -n $1 && $1 != -* ]] || fail 2 "the run's directory is '$*', allowed is one path: deploy/slurm/actor.sh RUN_DIR"
actor=$(program actor)
patience=$(number POPGYM_WAIT 3600 1 31536000)
files=$(realpath -m -- "$1").slurm
name=${SLURMD_NODENAME:-$(hostname)}.${SLURM_JOB_ID:-$$}.${SLURM_PROCID:-0}
failures=0
seen=$SECONDS # when there was a learner
waiting=

while [[ ! -e $files/complete ]]; do
    ((SECONDS - seen < patience)) ||
        fail 1 "no learner for $patience s: $files/current is what it says where it is. Does the job run, and do all nodes share this directory?"
    # One job's directory, though another may come meanwhile.
    if ! { secrets=$(realpath -e -- "$files/current") && address=$(cat "$secrets/address"); } 2>/dev/null; then
        [[ -n $waiting ]] || say "waiting for a learner in $files"
        waiting=1
        sleep 2
        continue
    fi
    waiting=
    door=(--token-file "$secrets/token")
    # Without TLS whoever is on the way could read the token: so POPGYM_TLS=off wants it.
    if [[ $address == https://* ]]; then door+=(--tls-ca "$secrets/ca.pem"); else door+=(--insecure); fi
    began=$SECONDS
    "$actor" --learner "$address" "${door[@]}" --name "$name" --retry-seconds "$retry" </dev/null && exit 0 || status=$?
    ((status != 2)) || exit 2
    lasted=$((SECONDS - began))
    ((lasted <= retry + 30)) || seen=$SECONDS
    ((failures = lasted < retry ? failures + 1 : 0))
    ((failures < attempts)) || fail 1 "the actor has failed $attempts times in a row (status $status)"
    say "the actor ended with status $status after $lasted s"
    sleep "$((failures * 2))"
done
