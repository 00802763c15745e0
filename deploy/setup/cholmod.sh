#!/usr/bin/env bash
# What scikit-sparse is compiled with: a C compiler, Python's headers and SuiteSparse.  Only backend="cholmod", and the tests
# and measurements that compare with CHOLMOD, need it.  Says what is missing and, where it may (root or password-less sudo,
# with apt-get), installs it; elsewhere it says how.  The exit code is 1 when something is still missing.
#
#     deploy/setup/cholmod.sh [PYTHON]
set -euo pipefail

main() {
    local python=${1:-python3} missing
    missing=$(what_is_missing "$python")
    [ -z "$missing" ] && return 0
    echo "set-up: missing for CHOLMOD: $missing" >&2
    if [ "${FACTORBUS_NO_SYSTEM:-}" = "" ] && try_apt; then
        missing=$(what_is_missing "$python")
        [ -z "$missing" ] && return 0
        echo "set-up: still missing after apt-get: $missing" >&2
    fi
    say_how
    return 1
}

what_is_missing() {
    local python=$1
    command -v cc >/dev/null || command -v gcc >/dev/null || echo -n "a C compiler; "
    has_header cholmod.h || echo -n "SuiteSparse's headers (cholmod.h); "
    "$python" -c 'import os, sysconfig, sys; sys.exit(not os.path.isfile(os.path.join(sysconfig.get_path("include"), "Python.h")))' ||
        echo -n "Python's headers (Python.h); "
}

# scikit-sparse looks in the same places (and in SUITESPARSE_INCLUDE_DIR, which its build honours).
has_header() {
    local folder
    for folder in "${SUITESPARSE_INCLUDE_DIR:-}" /usr/include/suitesparse /usr/include /usr/local/include/suitesparse \
        /usr/local/include /opt/homebrew/include/suitesparse /opt/homebrew/include /opt/local/include "${CONDA_PREFIX:-/nowhere}/include/suitesparse"; do
        [ -n "$folder" ] && [ -f "$folder/$1" ] && return 0
    done
    return 1
}

# OpenBLAS comes along because Debian's reference BLAS makes CHOLMOD several times slower.
try_apt() {
    local sudo=() packages=(build-essential python3-dev libsuitesparse-dev libopenblas0-pthread)
    command -v apt-get >/dev/null || return 1
    if [ "$(id -u)" != 0 ]; then
        { command -v sudo >/dev/null && sudo -n true 2>/dev/null; } || return 1
        sudo=(sudo -n)
    fi
    echo "set-up: ${sudo[*]} apt-get install ${packages[*]}" >&2
    local install=("${sudo[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends "${packages[@]}")
    "${install[@]}" >&2 || { "${sudo[@]}" apt-get update -q >&2 && "${install[@]}" >&2; }
}

say_how() {
    cat >&2 <<EOF
set-up: everything but backend="cholmod" works without it. To have it, install this and run the same command again:
  Debian, Ubuntu   sudo apt-get install build-essential python3-dev libsuitesparse-dev libopenblas0-pthread
  Fedora           sudo dnf install gcc python3-devel suitesparse-devel openblas-devel
  Arch             sudo pacman -S --needed base-devel suitesparse openblas
  macOS            xcode-select --install; brew install suite-sparse openblas
                   export SUITESPARSE_INCLUDE_DIR=\$(brew --prefix)/include/suitesparse SUITESPARSE_LIBRARY_DIR=\$(brew --prefix)/lib
EOF
}

main "$@"
