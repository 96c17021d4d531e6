#!/usr/bin/env bash
# `docker compose` for deploy/compose.yaml, or docker-compose where there is no such plugin: deploy/compose.sh COMMAND...
#
# Before `up` it makes what is missing of token and certificates. Commands for containers that are there see all profiles.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)

fail() {
    printf 'error: %s\n' "$*" >&2
    exit 1
}

if docker compose version >/dev/null 2>&1; then
    program=(docker compose)
elif command -v docker-compose >/dev/null; then
    program=(docker-compose)
else
    fail "neither 'docker compose' nor docker-compose is installed (Debian: apt-get install docker-compose)"
fi
told=$(docker version --format '{{.Server.Version}}' 2>&1) || fail "no Docker engine answers: ${told##*$'\n'}"

# What a setting is: the shell's, or that of .env.
setting() { # setting NAME DEFAULT
    local line
    line=$(grep -E "^$1=" "$here/.env" | tail -n 1 || true)
    line=${line#*=}
    [[ $line != [\"\']*[\"\'] ]] || line=${line:1:-1}
    printf '%s' "${!1-${line:-$2}}"
}

make_secrets() {
    local dir file hosts host kind
    dir=$(setting POPGYM_SECRETS ./secrets)
    [[ $dir == /* ]] || dir=$here/${dir#./}
    read -r -a hosts <<<"$(setting POPGYM_HOSTS '')"
    "$here/certificates.sh" "$dir" learner localhost 127.0.0.1 ${hosts[@]+"${hosts[@]}"}
    # The programs run as a user of their own in their containers, where no other secrets are; here the directory keeps others out.
    chmod 0700 "$dir"
    for file in token ca.pem learner.pem learner.key actor.pem actor.key; do
        chmod 0444 "$dir/$file"
    done
    for file in learner actor; do
        openssl x509 -in "$dir/$file.pem" -noout -checkend 0 >/dev/null ||
            fail "$dir/$file.pem has expired: remove it and $dir/$file.key, run this again, and then: deploy/compose.sh restart"
    done
    for host in ${hosts[@]+"${hosts[@]}"}; do
        kind=-checkhost
        [[ ! ($host =~ ^[0-9.]+$ || $host == *:*) ]] || kind=-checkip
        openssl x509 -in "$dir/learner.pem" -noout "$kind" "$host" | grep -q 'does match' ||
            fail "$dir/learner.pem is not for $host: remove it and $dir/learner.key, run this again, and then: deploy/compose.sh restart"
    done
}

case ${1:-} in
    up) make_secrets ;;
    down | events | images | kill | logs | pause | ps | restart | rm | start | stop | top | unpause)
        export COMPOSE_PROFILES=cpu,gpu,monitoring
        ;;
esac
exec "${program[@]}" --project-directory "$here" --file "$here/compose.yaml" "$@"
