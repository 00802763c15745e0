#!/usr/bin/env bash
# A Chromium for the tests that look at pages.  Installs it where it may (root or password-less sudo, with apt-get); where it
# may not, it says so and goes on: those tests are skipped, and say why.
#
#     deploy/setup/browser.sh
set -euo pipefail

main() {
    local name sudo=()
    for name in chromium chromium-browser google-chrome; do
        command -v "$name" >/dev/null && return 0
    done
    [ "$(id -u)" = 0 ] || sudo=(sudo -n)
    if [ "${FACTORBUS_NO_SYSTEM:-}" = "" ] && command -v apt-get >/dev/null && { [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null; }; then
        echo "set-up: ${sudo[*]} apt-get install chromium" >&2
        local install=("${sudo[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends chromium)
        { "${install[@]}" >&2 || { "${sudo[@]}" apt-get update -q >&2 && "${install[@]}" >&2; }; } && return 0
    fi
    echo "set-up: there is no Chromium: the tests that look at pages will be skipped (apt-get install chromium)" >&2
}

main "$@"
