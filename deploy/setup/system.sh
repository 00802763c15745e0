#!/usr/bin/env bash
# What pip cannot bring and nothing works without: Python's venv module.
# Says that it is missing and, where it may (root or password-less sudo, with apt-get), installs it; elsewhere it says how and stops.
#
#     deploy/setup/system.sh [PYTHON]
set -euo pipefail

main() {
    local python=${1:-python3}
    has_venv "$python" && return 0
    echo "set-up: missing on this machine: Python's venv and ensurepip modules" >&2
    if [ "${FACTORBUS_NO_SYSTEM:-}" = "" ] && try_apt; then
        has_venv "$python" && return 0
        echo "set-up: still missing after apt-get" >&2
    fi
    cat >&2 <<EOF
set-up: install it and run the same command again:
  Debian, Ubuntu   sudo apt-get install python3-venv
The interpreter is $(command -v "$python"); another one: make setup PYTHON=/path/to/python3.12
EOF
    return 1
}

has_venv() {
    "$1" -c 'import ensurepip, venv' 2>/dev/null
}

try_apt() {
    local sudo=()
    command -v apt-get >/dev/null || return 1
    if [ "$(id -u)" != 0 ]; then
        { command -v sudo >/dev/null && sudo -n true 2>/dev/null; } || return 1
        sudo=(sudo -n)
    fi
    echo "set-up: ${sudo[*]} apt-get install python3-venv" >&2
    local install=("${sudo[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends python3-venv)
    "${install[@]}" >&2 || { "${sudo[@]}" apt-get update -q >&2 && "${install[@]}" >&2; }
}

main "$@"
