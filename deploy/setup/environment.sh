#!/usr/bin/env bash
# Makes the virtual environment and installs the project into it, editable.  Run again, it only brings up to date.
#
#     deploy/setup/environment.sh VENV EXTRA[,EXTRA...]        PYTHON names the interpreter
set -euo pipefail

main() {
    local venv=$1 extras=$2 here python
    here=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
    python=$(interpreter)
    bash "$here/deploy/setup/system.sh" "$python"
    [[ ,$extras, != *,dev,* ]] || bash "$here/deploy/setup/browser.sh"
    # Left half made by an interrupted run, a virtual environment has no working pip: make it anew over itself.
    if ! "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
        echo "set-up: $("$python" --version) -> $venv" >&2
        "$python" -m venv --clear "$venv"
    fi
    echo "set-up: installing factorbus[$extras]" >&2
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --editable "$here[$extras]"
    [[ ,$extras, != *,dev,* ]] || try_cholmod "$here" "$venv" "$python"
}

# scikit-sparse is compiled, where that can be done.  Without it the tests that compare with CHOLMOD are skipped, and say why.
try_cholmod() {
    local here=$1 venv=$2 python=$3
    if bash "$here/deploy/setup/cholmod.sh" "$python"; then
        echo "set-up: installing factorbus[cholmod] (the first time takes some minutes: scikit-sparse is compiled)" >&2
        "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --editable "$here[cholmod]" && return 0
        echo "set-up: scikit-sparse could not be compiled; pip says why above" >&2
    fi
    echo "set-up: without CHOLMOD: backend=\"cholmod\" is refused, and the tests that compare with it are skipped" >&2
}

# PYTHON where it is given, else the first of the usual names that is new enough.
interpreter() {
    local name
    for name in ${PYTHON:-python3 python3.14 python3.13 python3.12 python3.11}; do
        if command -v "$name" >/dev/null && "$name" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            command -v "$name"
            return 0
        fi
    done
    echo "set-up: found no Python 3.11 or newer (looked for: ${PYTHON:-python3 python3.14 python3.13 python3.12 python3.11});" \
        "install one, or name it: make setup PYTHON=/path/to/python3.12" >&2
    return 1
}

main "$@"
