#!/usr/bin/env bash
# Builds the wheel and installs it, with the base dependencies only, into a virtual environment of its own:
# the four source roots must arrive as one namespace package, the light client must work without the service's extras,
# and what needs them must say so.  Then, with those extras, which are wheels only, the demo must run.
#
#     deploy/setup/try-wheel.sh PYTHON        PYTHON has pip; the build back end is brought by pip itself
set -euo pipefail

main() {
    local python=$1 here folder
    here=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
    folder=$(mktemp -d)
    # Expanded now: the variable is gone by the time the trap runs.
    # shellcheck disable=SC2064
    trap "rm -rf '$folder'" EXIT
    "$python" -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir "$folder/dist" "$here"
    "$python" -m venv "$folder/venv"
    "$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check "$folder"/dist/factorbus-*.whl
    cd "$folder"
    every_root_is_there
    light_client_works
    service_says_what_it_needs
    "$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check --only-binary :all: \
        "$(echo "$folder"/dist/factorbus-*.whl)[service,viz]"
    demo_runs
    cholmod_is_asked_for
    echo "wheel: $(cd dist && ls) is whole, light, and says what it lacks"
}

every_root_is_there() {
    venv/bin/python - <<'EOF'
from importlib.util import find_spec

for part in ("proto", "solver", "service", "formats", "workers", "client", "cli", "viz", "simulate", "gateway", "ros2"):
    assert find_spec(f"factorbus.{part}"), f"factorbus.{part} is not in the wheel"
assert find_spec("factorbus").origin is None, "factorbus must stay a namespace package"
EOF
}

demo_runs() {
    says "every one: 100 steps" venv/bin/factorbus demo --poses 100 --workers 1
    [ -s out/demo.png ]
}

cholmod_is_asked_for() {
    says "pip install 'factorbus[cholmod]'" venv/bin/python -c \
        'from factorbus.solver import Options, Solver; Solver(Options(backend="cholmod"))'
}

light_client_works() {
    says "factorbus demo" venv/bin/factorbus --help
    says "factorbus 0." venv/bin/factorbus version
    says "leave a variable free to move" venv/bin/factorbus explain underconstrained
    says "pip install 'factorbus[watch] @ file://" venv/bin/factorbus watch town
    says "pip install 'factorbus[gateway] @ file://" venv/bin/factorbus gateway
    says "pip install 'factorbus[ros2] @ file://" venv/bin/factorbus ros2 town
    venv/bin/python -c 'import sys, factorbus.client; assert not {"numba", "scipy", "sksparse"} & set(sys.modules)'
}

service_says_what_it_needs() {
    says "pip install 'factorbus[service] @ file://" venv/bin/factorbus serve
    says "pip install 'factorbus[service] @ file://" venv/bin/factorbus demo
}

# Whether the output of a command holds a text; the whole output is read first, or the command would die of a closed pipe.
says() {
    local wanted=$1 said
    shift
    said=$("$@" 2>&1) || true
    [[ $said == *"$wanted"* ]] || {
        echo "wheel: wanted '$wanted' from: $*; it said: $said" >&2
        return 1
    }
}

main "$@"
