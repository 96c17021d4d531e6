#!/usr/bin/env bash
# deploy/Dockerfile, deploy/compose.yaml and `make up` for real: images built on bases that are made here, so that no registry of
# images is asked; a learner, three actors and Prometheus in containers, struck in turn; the curve of a run that nobody disturbed.
#
#   tests/containers.sh          the whole test; the first takes long, because bases and dependencies are built (they are kept)
#   tests/containers.sh check    whether it can run here: if not, status 77 and the reason
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"

readonly suite=bookworm limit_mb=900 actors=3
readonly -a train=(--env RepeatPreviousEasy --seed 1 --threads 1 --steps 600000 --checkpoint-epochs 2
    --batch-steps 4096 --minibatch-steps 2048)
readonly project=popgym-test-$$
# Before anything is removed by this name.
export COMPOSE_PROJECT_NAME=$project
work=

say() { printf '==> %s\n' "$*"; }
fail() {
    printf 'failed: %s\n' "$*" >&2
    exit 1
}
skip() {
    printf '%s\n' "$*"
    exit 77
}

check() {
    command -v docker >/dev/null || skip "docker is not installed"
    docker version >/dev/null 2>&1 || skip "no Docker engine answers"
    docker compose version >/dev/null 2>&1 || command -v docker-compose >/dev/null || skip "docker compose is not installed"
    command -v openssl >/dev/null || skip "openssl is not installed"
    [[ $EUID == 0 ]] || skip "debootstrap, which makes the base image, needs root"
    command -v debootstrap >/dev/null || command -v apt-get >/dev/null || skip "debootstrap is not installed"
}

# ---------------------------------------------------------------------------------------------------------------- base images

# debootstrap, without installing it where it is not.
bootstrap() { # bootstrap DIR
    if command -v debootstrap >/dev/null; then
        debootstrap --variant=minbase "$suite" "$1"
        return
    fi
    (
        cd "$work"
        apt-get download debootstrap || { apt-get update && apt-get download debootstrap; }
        dpkg-deb --extract debootstrap_*.deb debootstrap
    )
    DEBOOTSTRAP_DIR=$work/debootstrap/usr/share/debootstrap "$work/debootstrap/usr/sbin/debootstrap" \
        --variant=minbase "$suite" "$1"
}

has_image() { docker image inspect "$1" >/dev/null 2>&1; }

make_bases() {
    local sysroot rust certificates=/etc/ssl/certs/ca-certificates.crt
    sysroot=$(rustc --print sysroot)
    rust=popgym-test-rust:$(rustc --version | cut -d' ' -f2)
    run_image=popgym-test-debian:$suite build_image=popgym-test-build:$suite prometheus_image=popgym-test-prometheus:$suite

    if ! has_image "$run_image"; then
        say "making a base image with debootstrap"
        bootstrap "$work/debian" >"$work/debootstrap.log" || {
            tail -n 20 "$work/debootstrap.log" >&2
            fail "debootstrap"
        }
        chroot "$work/debian" apt-get clean
        rm -rf "$work/debian"/var/lib/apt/lists/*
        tar -C "$work/debian" --create . | docker import - "$run_image" >/dev/null
        rm -rf "$work/debian"
    fi
    if ! has_image "$rust"; then
        say "importing this machine's Rust"
        tar -C "$sysroot" --create --exclude lib/rustlib/src bin lib | docker import - "$rust" >/dev/null
    fi

    # From here on the engine's own cache keeps what is there. This machine's certificates: it may reach package registries
    # through somebody who has one of his own.
    mkdir "$work/build"
    if [[ -e $certificates ]]; then cp "$certificates" "$work/build/certificates"; else : >"$work/build/certificates"; fi
    cat >"$work/build/Dockerfile" <<DOCKERFILE
FROM $rust AS rust
FROM $run_image
RUN apt-get update && apt-get install --yes --no-install-recommends ca-certificates
COPY certificates /etc/ssl/certs/more
RUN cat /etc/ssl/certs/more >>/etc/ssl/certs/ca-certificates.crt
COPY --from=rust / /usr/local/
DOCKERFILE
    mkdir "$work/prometheus"
    cat >"$work/prometheus/Dockerfile" <<DOCKERFILE
FROM $run_image
RUN apt-get update && apt-get install --yes --no-install-recommends prometheus \
    && mkdir /prometheus && chown nobody:nogroup /prometheus
USER nobody
ENTRYPOINT ["prometheus"]
DOCKERFILE
    say "building $build_image and $prometheus_image"
    docker build --quiet --tag "$build_image" "$work/build"
    docker build --quiet --tag "$prometheus_image" "$work/prometheus"
}

# -------------------------------------------------------------------------------------------------------------------- helpers

compose() { deploy/compose.sh "$@"; }

# The containers of a service, those that have ended too.
containers() { # containers SERVICE
    docker ps --all --quiet --filter "label=com.docker.compose.project=$project" \
        --filter "label=com.docker.compose.service=$1" "${@:2}"
}
inspect() { docker inspect --format "$2" "$1"; }

# The process of a program in a container, as this machine numbers it.
process() { # process CONTAINER PROGRAM
    docker top "$1" -eo pid,comm | awk -v name="$2" '$2 == name { print $1 }'
}

# A wait only tells what hangs from a busy machine: the bounds that count are checked apart.
wait_for() { # wait_for SECONDS WHAT COMMAND...
    local end=$((SECONDS + $1)) what=$2
    shift 2
    until "$@"; do
        ((SECONDS < end)) || fail "waited too long for $what"
        sleep 0.2
    done
}

get() { # get URL: what is there, by no proxy
    python3 - "$1" <<'PYTHON'
import sys, urllib.request
opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
try:
    print(opener.open(sys.argv[1], timeout=5).read().decode())
except OSError as error:
    sys.exit(f"{sys.argv[1]}: {error}")
PYTHON
}

# The number that Prometheus has for a query; nothing if it has none.
ask() { # ask QUERY
    python3 - "http://$POPGYM_PROMETHEUS" "$1" <<'PYTHON'
import json, sys, urllib.parse, urllib.request
opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
url = f"{sys.argv[1]}/api/v1/query?" + urllib.parse.urlencode({"query": sys.argv[2]})
try:
    result = json.load(opener.open(url, timeout=5))["data"]["result"]
except OSError:
    result = []
if result:
    print(f"{float(result[0]['value'][1]):.0f}")
PYTHON
}
asked() { # asked QUERY OPERATOR NUMBER
    local value
    value=$(ask "$1")
    [[ -n $value ]] && test "$value" "$2" "$3"
}

learner_says() { # learner_says METRIC OPERATOR NUMBER: now, not when Prometheus last asked
    local value
    value=$(get "http://$POPGYM_PAGE/metrics" 2>/dev/null | awk -v name="$1" '$1 == name { print int($2) }')
    [[ -n $value ]] && test "$value" "$2" "$3"
}

# ----------------------------------------------------------------------------------------------------------------------- steps

undisturbed_run() {
    say "a run that nobody disturbs, in one container"
    docker run --rm --network none --read-only --tmpfs /tmp --volume "$project-undisturbed:/runs" \
        "popgym-learner:$POPGYM_TAG" train --out /runs/it --actors 1 "${train[@]}" >"$work/undisturbed.log" 2>&1 || {
        cat "$work/undisturbed.log" >&2
        fail "the undisturbed run"
    }
    of_run "$project-undisturbed" it/metrics.csv >"$work/expected.csv"
}

of_run() { # of_run VOLUME FILE
    docker run --rm --network none --volume "$1:/runs:ro" --entrypoint cat "popgym-learner:$POPGYM_TAG" "/runs/$2"
}

sizes() {
    local image mb
    for image in popgym-actor popgym-learner; do
        mb=$(($(docker image inspect --format '{{.Size}}' "$image:$POPGYM_TAG") / 1000000))
        say "image $image: $mb MB"
        [[ $image != popgym-actor ]] || ((mb < limit_mb)) || fail "the actor's image has $mb MB, allowed are $limit_mb"
    done
}

guarded() { # what a container may do is no more than it must
    local container=$1
    [[ $(inspect "$container" '{{.Config.User}}') == 10001:10001 ]] || fail "$container does not run as user 10001"
    [[ $(docker exec "$container" id -u) == 10001 ]] || fail "$container runs as root"
    ! docker exec "$container" touch /opt/popgym/written 2>/dev/null || fail "$container can write to its image"
    ! inspect "$container" '{{json .Config}}' | grep -qF "$(<"$POPGYM_SECRETS/token")" || fail "$container has its token in its settings"
}

on_metrics_network() {
    docker network inspect --format '{{range .Containers}}{{.Name}}{{"\n"}}{{end}}' "${project}_metrics" |
        sed -E "s/^${project}[-_](.*)[-_][0-9]+\$/\1/" | grep . | sort | uniq -c | awk '{ printf "%s%s=%s", sep, $2, $1; sep = " " }'
}

come_up() {
    local began=$SECONDS
    say "make up, $actors actors"
    POPGYM_ACTORS=$actors make --no-print-directory up >"$work/up.log" 2>&1 || {
        cat "$work/up.log" >&2
        fail "make up"
    }
    grep -q "without grafana" "$work/up.log" || fail "make up does not tell that Grafana's image cannot be had"
    say "up after $((SECONDS - began)) s"
    began=$SECONDS
    wait_for 120 "steps in Prometheus" asked popgym_learner_env_steps_total -gt 0
    ((SECONDS - began <= 60)) || fail "steps are in Prometheus after $((SECONDS - began)) s, allowed are 60"
    wait_for 120 "all actors in Prometheus" asked 'sum(up{job="actor"})' -eq $actors
    wait_for 120 "sampling by every actor" asked 'count(popgym_actor_steps_total > 0)' -eq $actors
    say "learner and $actors actors in Prometheus $((SECONDS - began)) s later"
    asked popgym_learner_actors -eq $actors || fail "the learner counts other actors"
    [[ $(on_metrics_network) == "actor=$actors learner=1 prometheus=1" ]] || fail "on the metrics' network: $(on_metrics_network)"
    [[ $(docker network inspect --format '{{.Internal}}' "${project}_metrics") == true ]] || fail "a way out of the metrics' network"
    local container
    for container in $(containers learner) $(containers actor); do
        guarded "$container"
        wait_for 120 "a healthy $container" is_healthy "$container"
    done
}
is_healthy() { [[ $(inspect "$1" '{{.State.Health.Status}}') == healthy ]]; }

lose_actors() {
    local all first second
    all=$(containers actor)
    first=$(head -n 1 <<<"$all") second=$(tail -n 1 <<<"$all")
    say "an actor's container is killed"
    docker kill "$first" >/dev/null
    wait_for 120 "Prometheus without it" asked 'sum(up{job="actor"})' -eq $((actors - 1))
    wait_for 120 "a learner without it" learner_says popgym_learner_actors -eq $((actors - 1))
    say "another's process is killed"
    kill -KILL "$(process "$second" actor)"
    wait_for 120 "its restart" restarted "$second" 1
    wait_for 120 "its return" learner_says popgym_learner_actors -eq $((actors - 1))
}
restarted() { [[ $(inspect "$1" '{{.State.Running}} {{.RestartCount}}') == "true $2" ]]; }

add_actors() {
    local before new container address began
    before=$(containers actor | sort)
    say "one more actor than there were"
    compose up --detach --no-recreate --scale actor=$((actors + 1)) >"$work/scale.log" 2>&1
    new=$(containers actor | sort | comm -13 <(echo "$before") -)
    [[ $(wc -w <<<"$new") == 1 ]] || fail "new actors: '$new'"
    address=$(inspect "$new" "{{(index .NetworkSettings.Networks \"${project}_metrics\").IPAddress}}")
    wait_for 120 "its steps" has_sampled "$address"
    python3 - "$(inspect "$new" '{{.State.StartedAt}}')" <<'PYTHON' || fail "that is more than 5 s"
import sys, time, calendar
seconds = time.time() - calendar.timegm(time.strptime(sys.argv[1][:19], "%Y-%m-%dT%H:%M:%S")) - float("0" + sys.argv[1][19:-1])
print(f"==> samples {seconds:.1f} s after its start")
sys.exit(seconds > 5)
PYTHON
    wait_for 120 "$((actors + 1)) actors" learner_says popgym_learner_actors -eq $((actors + 1))
}
has_sampled() { get "http://$1:9101/metrics" 2>/dev/null | grep -qE '^popgym_actor_steps_total [1-9]'; }

strike_learner() {
    local learner=$1 began
    say "the learner's process is killed"
    kill -KILL "$(process "$learner" learner)"
    wait_for 120 "its restart" restarted "$learner" 1
    wait_for 120 "the return of its actors" learner_says popgym_learner_actors -eq $((actors + 1))
    wait_for 120 "another checkpoint" learner_says popgym_learner_env_steps_total -gt 20000
    began=$SECONDS
    compose stop learner >/dev/null 2>&1
    say "the learner is stopped, in $((SECONDS - began)) s"
    [[ $(inspect "$learner" '{{.State.Running}} {{.State.ExitCode}}') == "false 143" ]] ||
        fail "stopped, it ended with $(inspect "$learner" '{{.State.ExitCode}}')"
    wait_for 120 "Prometheus to see that it is gone" asked 'up{job="learner"}' -eq 0
    say "make up again"
    POPGYM_ACTORS=$((actors + 1)) make --no-print-directory up >"$work/again.log" 2>&1
}

ended_well() {
    local container
    for container in $(containers learner) $(containers actor); do
        [[ $(inspect "$container" '{{.State.Status}} {{.State.ExitCode}}') == "exited 0" ]] || return 1
    done
}

main() {
    local learner
    trap clean_up EXIT
    work=$(mktemp -d)
    make_bases
    read -r POPGYM_LISTEN POPGYM_PAGE POPGYM_PROMETHEUS POPGYM_GRAFANA < <(free_addresses 4)
    export POPGYM_LISTEN POPGYM_PAGE POPGYM_PROMETHEUS POPGYM_GRAFANA
    export COMPOSE_PROFILES=cpu POPGYM_SECRETS=$work/secrets POPGYM_TAG=test POPGYM_TRAIN="${train[*]}"
    export BUILD_IMAGE=$build_image RUN_IMAGE=$run_image PROMETHEUS_IMAGE=$prometheus_image GRAFANA_IMAGE=popgym-test-grafana:none

    say "building the images"
    compose build learner actor >"$work/build.log" 2>&1 || {
        tail -n 60 "$work/build.log" >&2
        fail "the build"
    }
    sizes
    undisturbed_run

    come_up
    learner=$(containers learner)
    wait_for 120 "a checkpoint" learner_says popgym_learner_env_steps_total -gt 20000
    lose_actors
    add_actors
    strike_learner "$learner"
    say "waiting for the run's end"
    wait_for 600 "the run's end" ended_well
    sleep 3
    ended_well || fail "what had ended has started again"
    of_run "${project}_runs" first/metrics.csv >"$work/metrics.csv"
    cmp "$work/expected.csv" "$work/metrics.csv" || fail "the curve is not that of the undisturbed run"
    say "the same curve, $(wc -l <"$work/metrics.csv") lines"
    of_run "${project}_runs" first/events.jsonl | python3 tests/resumed.py 3 || fail "not each new learner has gone on from a checkpoint"
    asked 'count(count_over_time(popgym_learner_return_mean[1h]) > 5)' -ge 1 || fail "Prometheus has no curve"
    asked 'max(max_over_time(popgym_learner_env_steps_total[1h]))' -gt 20000 || fail "Prometheus has not seen the run"

    say "make down"
    make --no-print-directory down >/dev/null 2>&1
    [[ -z $(docker ps --all --quiet --filter "label=com.docker.compose.project=$project") ]] || fail "containers are left"
    docker volume inspect "${project}_runs" >/dev/null || fail "the run is gone"
    say "all of it holds"
}

free_addresses() { # free_addresses N
    python3 - "$1" <<'PYTHON'
import socket, sys
sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(int(sys.argv[1]))]
print(*(f"127.0.0.1:{s.getsockname()[1]}" for s in sockets))
PYTHON
}

clean_up() {
    local status=$?
    if ((status != 0)) && [[ -n $(containers learner) ]]; then
        compose ps >&2 || true
        compose logs --no-color --tail 40 >&2 || true
    fi
    compose down --volumes >/dev/null 2>&1 || true
    docker volume rm --force "$project-undisturbed" >/dev/null 2>&1 || true
    rm -rf "$work"
    exit "$status"
}

case ${1:-} in
    '')
        check
        main
        ;;
    check) check ;;
    *) fail "unknown argument '$1', allowed is: check" ;;
esac
