#!/usr/bin/env bash
# Puts libtorch into a cache that all checkouts of this user share and links .libtorch to it.
# Safe to run any number of times: it downloads only what is not there whole.
#
#   POPGYM_CACHE   where to keep libtorch   (default: ~/.cache/popgym-rs)
#   POPGYM_TORCH   cpu or cuda              (default: cuda where there is an NVIDIA driver)
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
readonly root
readonly version=2.11.0

cache=${POPGYM_CACHE:-${XDG_CACHE_HOME:-${HOME:-$root}/.cache}/popgym-rs}
[[ $cache == /* ]] || cache=$PWD/$cache
arch=$(uname -m)
work=
missing=0

say() { printf '==> %s\n' "$*"; }
miss() {
    printf 'missing: %s\n' "$*" >&2
    missing=1
}
fail() {
    printf 'set-up failed: %s\n' "$*" >&2
    exit 1
}

at_least() { # at_least HAVE WANT: versions with dots
    [[ $(printf '%s\n%s\n' "$2" "$1" | sort -V | head -n 1) == "$2" ]]
}

choose_flavour() {
    local driver major
    case ${POPGYM_TORCH:-} in
        cpu | cuda)
            flavour=$POPGYM_TORCH
            return
            ;;
        '') ;;
        *) fail "POPGYM_TORCH is '$POPGYM_TORCH'; it must be cpu or cuda" ;;
    esac
    flavour=cpu
    if [[ -r /proc/driver/nvidia/version ]]; then
        driver=$(head -n 1 /proc/driver/nvidia/version)
    elif ! driver=$(nvidia-smi --query-gpu=driver_version --format=csv,noheader 2>/dev/null); then
        return 0
    fi
    major=$(grep -oE '[0-9]{3,}\.[0-9]+' <<<"$driver" | head -n 1 | cut -d. -f1 || true)
    if [[ -n $major ]] && ((major < 580)); then
        say "the NVIDIA driver $major is too old for CUDA 13, which needs 580: only the CPU part"
        return
    fi
    flavour=cuda
}

check_platform() {
    local libc
    [[ $(uname -s) == Linux ]] || miss "a supported system: only Linux is supported, this is $(uname -s)"
    case $arch in
        x86_64) ;;
        aarch64) say "note: aarch64 has never been tried" ;;
        *) miss "a supported processor: x86_64 (or, untried, aarch64), this is $arch" ;;
    esac
    libc=$(getconf GNU_LIBC_VERSION 2>/dev/null || true)
    at_least "${libc#glibc }" 2.28 || miss "glibc 2.28 or newer (found: ${libc:-another C library})"
}

check_rust() {
    local want have
    if ! command -v cargo >/dev/null || ! command -v rustc >/dev/null; then
        miss "Rust: cargo and rustc are not in PATH (rustup installs them)"
        return
    fi
    want=$(sed -n 's/^rust-version *= *"\(.*\)"/\1/p' "$root/Cargo.toml" | head -n 1)
    # In the checkout, because rust-toolchain.toml decides which rustc it is.
    if ! have=$(cd "$root" && rustc --version 2>&1); then
        miss "a working Rust: ${have%%$'\n'*}"
        return
    fi
    have=$(grep -oE '[0-9]+\.[0-9]+\.[0-9]+' <<<"$have" | head -n 1)
    at_least "$have" "$want" || miss "Rust $want or newer (found $have; rustup update stable)"
}

check_compiler() {
    local -a cxx
    read -r -a cxx <<<"${CXX:-c++}"
    command -v cc >/dev/null || miss "a C compiler to link with: cc is not in PATH (Debian: apt-get install g++)"
    if ! command -v "${cxx[0]}" >/dev/null; then
        miss "a C++ compiler: ${cxx[0]} is not in PATH (Debian: apt-get install g++)"
    elif ! printf '#include <string_view>\n' | "${cxx[@]}" -std=c++17 -fsyntax-only -x c++ - 2>/dev/null; then
        miss "a C++17 compiler with its library's headers: ${cxx[*]} cannot compile #include <string_view>"
    fi
}

has_python() { python3 -c 'import sys; sys.exit(sys.version_info < (3, 8))' 2>/dev/null; }

# Runs pip untouched by what the user has set for installing: this only downloads.
pip_clean() {
    env -u PIP_TARGET -u PIP_PREFIX -u PIP_USER -u PIP_NO_BINARY -u PIP_ONLY_BINARY -u PIP_CONSTRAINT \
        PIP_REQUIRE_VIRTUALENV=0 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_INPUT=1 "${pip[@]}" "$@"
}

check_pip() {
    local have candidate
    for candidate in "python3 -m pip" pip3 pip; do
        read -r -a pip <<<"$candidate"
        have=$(pip_clean --version 2>/dev/null | cut -d' ' -f2) && [[ -n $have ]] && break
        have=
    done
    if [[ -z $have ]]; then
        miss "pip (Debian: apt-get install python3-pip; elsewhere: python3 -m ensurepip)"
    elif ! at_least "$have" 20.3; then
        miss "pip 20.3 or newer (found $have; python3 -m pip install --upgrade pip)"
    fi
}

check_room() {
    local free need=2
    [[ $flavour == cpu ]] || need=8
    if ! mkdir -p "$cache" 2>/dev/null || [[ ! -w $cache ]]; then
        miss "a place to keep libtorch: cannot write to $cache (POPGYM_CACHE=... names another)"
        return
    fi
    free=$(df -Pk "$cache" | awk 'NR == 2 { print int($4 / 1048576) }')
    ((free >= need)) || miss "disk space: $cache needs $need GB free, there are $free (POPGYM_CACHE=... names another place)"
}

# Every file's size and every link's target: quick enough to compare each time.
list_files() {
    (cd "$1" && find . \( -type f -o -type l \) ! -name MANIFEST -printf '%s %p %l\n' | LC_ALL=C sort)
}

is_whole() {
    [[ -f $1/MANIFEST ]] && list_files "$1" | cmp -s - "$1/MANIFEST"
}

download() { # download DIR
    local tag try
    local -a platforms=(--platform "manylinux2014_$arch")
    for tag in {28..5}; do
        platforms+=(--platform "manylinux_2_${tag}_$arch")
    done
    for try in 1 2; do
        # The same wheels whatever the local Python: what is inside does not depend on it.
        # TMPDIR, because pip puts whole wheels there first, and /tmp may be small.
        if TMPDIR=$work pip_clean download --no-cache-dir --no-deps --require-hashes --only-binary=:all: \
            --python-version 3.11 --implementation cp --abi cp311 "${platforms[@]}" \
            --dest "$1" --requirement "$root/deploy/torch-$flavour.txt"; then
            return
        fi
        ((try == 2)) || say "the download failed; trying once more"
    done
    fail "could not download libtorch: no network, a proxy that pip is not told of, or not the expected file (pip's message is above)"
}

# Links and runs a program as the build does: against lib/ only, the CUDA half opened at run time.
self_check() { # self_check ENTRY
    local dir=$work/check
    local -a cxx
    read -r -a cxx <<<"${CXX:-c++}"
    mkdir -p "$dir"
    cat >"$dir/check.cpp" <<'CPP'
#include <cstdio>
#include <dlfcn.h>
namespace at { int get_num_threads(); }
int main(int argc, char **) {
    if (at::get_num_threads() < 1) return 1;
    if (argc == 1 || dlopen("libtorch_cuda.so", RTLD_NOW | RTLD_GLOBAL)) return 0;
    std::fprintf(stderr, "%s\n", dlerror());
    return 1;
}
CPP
    "${cxx[@]}" "$dir/check.cpp" -o "$dir/check" -L "$1/lib" -Wl,--as-needed -lc10 -ltorch_cpu -ltorch -ldl \
        "-Wl,-rpath,$1/lib:$1/cuda" || fail "a program does not link against libtorch (the linker's message is above)"
    local -a cuda=()
    [[ $flavour == cpu ]] || cuda=(cuda)
    "$dir/check" ${cuda[@]+"${cuda[@]}"} || fail "a program linked against libtorch does not run (its message is above)"
}

install_libtorch() { # install_libtorch ENTRY
    local new=$work/entry
    if [[ -e $1 ]]; then
        say "libtorch in $1 is damaged; getting it again"
    fi
    say "downloading libtorch $version, $flavour part ($([[ $flavour == cpu ]] && echo 0.5 || echo 2.5) GB)"
    download "$work/wheels"
    say "unpacking libtorch"
    python3 "$root/deploy/unpack.py" "$flavour" "$work/wheels" "$new" || fail "could not unpack libtorch"
    echo "$version" >"$new/build-version" # torch-sys compares this with the version that it is made for
    say "checking that programs link and run with it"
    self_check "$new"
    list_files "$new" >"$work/MANIFEST"
    mv "$work/MANIFEST" "$new/MANIFEST"
    # Renames, so that others see the old one or the new one and never half of it.
    [[ ! -e $1 ]] || mv -T "$1" "$work/old"
    mv -T "$new" "$1"
}

link_checkout() { # link_checkout ENTRY
    [[ $(readlink "$root/.libtorch" || true) != "$1" ]] || return 0
    [[ -L $root/.libtorch || ! -e $root/.libtorch ]] || fail "$root/.libtorch is in the way: it must be a link"
    ln -sfn "$1" "$root/.libtorch.$$.tmp"
    mv -T "$root/.libtorch.$$.tmp" "$root/.libtorch"
    say "linked .libtorch to $1"
}

main() {
    local entry
    choose_flavour
    entry=$cache/libtorch-$version-$flavour-$arch

    check_platform
    check_rust
    check_compiler
    has_python || miss "Python 3.8 or newer: python3 (Debian: apt-get install python3 python3-pip)"
    if ! is_whole "$entry"; then
        check_pip
        check_room
        ((missing == 0)) || exit 1

        # One set-up at a time; the lock goes with the process, however it ends.
        exec 9>"$cache/lock"
        if ! python3 -c 'import fcntl; fcntl.flock(9, fcntl.LOCK_EX | fcntl.LOCK_NB)' 2>/dev/null; then
            say "waiting for another set-up that uses $cache"
            python3 -c 'import fcntl; fcntl.flock(9, fcntl.LOCK_EX)'
        fi
        if ! is_whole "$entry"; then
            rm -rf "$cache"/setup.?????? # left by runs that were killed
            work=$(mktemp -d "$cache/setup.XXXXXX")
            trap 'rm -rf "$work"' EXIT
            install_libtorch "$entry"
        fi
    fi
    ((missing == 0)) || exit 1
    link_checkout "$entry"
    say "libtorch $version ($flavour) is in place"
}

main "$@"
