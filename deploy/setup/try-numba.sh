#!/usr/bin/env bash
# Runs tests of the solver with other releases of Numba, each in a virtual environment of its own: with Numba as it is, and
# with what we change in it.  A release that passes both belongs to TESTED in service/factorbus/solver/kernels/jit/releases.py,
# and the one after the newest that passes bounds `numba` in pyproject.toml.
#
#     deploy/setup/try-numba.sh FOLDER RELEASE[,RELEASE...] [TESTS...]        RELEASE as 0.67, for the newest of those, or 0.67.0
#
# FOLDER keeps the environments and compiled kernels for the next time.  Without TESTS it runs tests/solver: with Numba as it
# is, to compile the step alone takes some minutes.  WAYS=stock or WAYS=changed in the environment: only that way.  TIMEOUT:
# seconds for one test, 1200 by default; the first one compiles, and a machine with other work needs more.
set -euo pipefail

main() {
    [ $# -ge 2 ] || { sed -n 's/^# *//; /try-numba.sh FOLDER/p' "${BASH_SOURCE[0]}" >&2; return 2; }
    local folder=$1 releases=$2 ways=${WAYS:-stock changed} here release failed=()
    shift 2
    [ $# -gt 0 ] || set -- tests/solver
    mkdir -p "$folder"
    folder=$(cd "$folder" && pwd)
    here=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
    cd "$here"
    for release in ${releases//,/ }; do
        environment "$folder/$release" "$release" "$here"
        [[ $ways != *stock* ]] || try "as it is" 1 "$folder/$release" "$@" || failed+=("$release as it is")
        [[ $ways != *changed* ]] || try "changed" 0 "$folder/$release" "$@" || failed+=("$release changed")
    done
    [ ${#failed[@]} = 0 ] && return 0
    printf 'numba %s: tests failed\n' "${failed[@]}" >&2
    return 1
}

environment() {
    local venv=$1/venv release=$2 here=$3
    [[ $release = *.*.* ]] || release=$release.*
    "$venv/bin/python" -c 'import gtsam, hypothesis, pytest, pytest_timeout' 2>/dev/null && return 0
    "${PYTHON:-python3}" -m venv --clear "$venv"
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --editable "$here[service]" "numba==$release" \
        "gtsam>=4.3" "hypothesis>=6.100" "pytest>=8" "pytest-timeout>=2.3"
}

# 0: changed, whatever the release.
try() {
    local how=$1 stock=$2 folder=$3 installed
    shift 3
    installed=$("$folder/venv/bin/python" -c 'from importlib.metadata import version; print(version("numba"))')
    echo "numba $installed, $how"
    FACTORBUS_STOCK_NUMBA=$stock FACTORBUS_CACHE=$folder/cache \
        "$folder/venv/bin/python" -m pytest -q -p no:cacheprovider -m "not data" --timeout "${TIMEOUT:-1200}" "$@"
}

main "$@"
