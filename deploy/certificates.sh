#!/usr/bin/env bash
# Makes a certificate authority for one cluster, certificates that it signs, and a token. What is there already stays.
#
#   deploy/certificates.sh DIR HOST...     HOST: a name or address by which actors reach the learner
#
# In DIR afterwards: ca.pem (for everyone), ca.key (keep it off the cluster), learner.pem and learner.key, actor.pem and
# actor.key, and token. Certificates are good for POPGYM_DAYS days (default: 365); to renew one remove its files first.
set -euo pipefail

usage() {
    sed -n 's/^#   \(deploy.*\)/usage: \1/p' "$0" >&2
    exit 2
}
[[ $# -ge 2 && $1 != -* ]] || usage
command -v openssl >/dev/null || {
    echo "missing: openssl" >&2
    exit 1
}
dir=$1
shift
days=${POPGYM_DAYS:-365}

names=
for host in "$@"; do
    kind=DNS
    [[ $host =~ ^[0-9.]+$ || $host == *:* ]] && kind=IP
    names+=,$kind:$host
done

umask 077
mkdir -p "$dir"
# The system's own configuration may add what is said here a second time (OpenSSL 1.1).
request() { openssl req -config <(printf '[req]\ndistinguished_name = name\n[name]\n') -new "$@"; }
new_key() { openssl ecparam -name prime256v1 -genkey -noout | openssl pkcs8 -topk8 -nocrypt -out "$1"; }

if [[ ! -e $dir/ca.pem ]]; then
    new_key "$dir/ca.key"
    request -x509 -key "$dir/ca.key" -days "$((days * 10))" -subj "/CN=popgym-rs cluster" \
        -addext basicConstraints=critical,CA:TRUE -addext keyUsage=critical,keyCertSign,cRLSign -out "$dir/ca.pem"
    echo "made $dir/ca.pem"
fi

issue() { # issue NAME EXTENSIONS
    [[ ! -e $dir/$1.pem ]] || return 0
    new_key "$dir/$1.key"
    request -key "$dir/$1.key" -subj "/CN=popgym-rs $1" |
        openssl x509 -req -CA "$dir/ca.pem" -CAkey "$dir/ca.key" -CAcreateserial -days "$days" -out "$dir/$1.pem" \
            -extfile <(printf 'basicConstraints=critical,CA:FALSE\nkeyUsage=critical,digitalSignature\n%s\n' "$2") 2>/dev/null
    echo "made $dir/$1.pem"
}
issue learner "$(printf 'extendedKeyUsage=serverAuth\nsubjectAltName=%s' "${names#,}")"
issue actor "extendedKeyUsage=clientAuth"

if [[ ! -e $dir/token ]]; then
    openssl rand -hex 32 >"$dir/token"
    echo "made $dir/token"
fi
